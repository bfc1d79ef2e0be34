"""Configuring drives when connecting: identity, PDOs, times. Enables nothing."""

from __future__ import annotations

from typing import Any

from gapbridge.core.arm import Arm
from gapbridge.core.errors import InputError, LinkError
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.objects import PDO_COUNT, Address
from gapbridge.drivers.canopen.pdo import PdoLayout
from gapbridge.drivers.canopen.profile import CanopenProfile

DEVICE_TYPE, SUPPORTED_MODES = Address(0x1000, 0), Address(0x6502, 0)
SYNC_PERIOD, HEARTBEAT_TIME = Address(0x1006, 0), Address(0x1017, 0)
PERIOD_VALUE, PERIOD_INDEX = Address(0x60C2, 1), Address(0x60C2, 2)
LOWEST, HIGHEST = Address(0x607D, 1), Address(0x607D, 2)
CIA402 = 402
SYNCHRONOUS = 1  # transmission type: at every SYNC
OTHER_SIZE = 4.0  # largest ratio between the range of a drive's software limits and the joint's
UNLIMITED = 0x7FFFFFFE  # counts


def check_identity(master: Master, profile: CanopenProfile, node: int) -> None:
    """Raise LinkError for a node that is not a CiA 402 drive with the profile's mode."""
    device_profile = master.read(node, DEVICE_TYPE) & 0xFFFF
    if device_profile != CIA402:
        raise LinkError(
            f"{master.where}: node {node}: found device profile {device_profile}, "
            "expected 402 (a drive)"
        )
    modes = master.read_where_present(node, SUPPORTED_MODES)
    if modes is not None and not modes >> (profile.mode_number - 1) & 1:
        raise LinkError(
            f"{master.where}: node {node}: found supported drive modes 0x{modes:X}, expected "
            f"{profile.file.mode} among them"
        )


def check_units(master: Master, profile: CanopenProfile, arm: Arm) -> None:
    """Compare the drives' software position limits with the arm's range. Raises LinkError.

    If their sizes differ by more than OTHER_SIZE, counts_per_turn or gear is wrong.
    """
    span = arm.limits.upper - arm.limits.lower
    for joint, node in enumerate(profile.nodes):
        low = master.read_where_present(node, LOWEST)
        high = master.read_where_present(node, HIGHEST)
        if low is None or high is None or low >= high or max(-low, high) >= UNLIMITED:
            continue
        reported = (high - low) / abs(profile.counts_per_radian[joint])
        if not 1.0 / OTHER_SIZE <= reported / span[joint] <= OTHER_SIZE:
            raise LinkError(
                f"{master.where}: node {node}: found software position limits {reported:.4g} rad "
                f"apart, and joint {joint + 1} can turn {span[joint]:.4g} rad: are counts_per_turn "
                f"and gear of {profile.path.name} right?"
            )


def set_up(master: Master, profile: CanopenProfile, node: int, period: float) -> None:
    """Set one drive's PDOs and times, or check them. Raises LinkError."""
    for layout in (*profile.tpdo, *profile.rpdo):
        if profile.file.pdo_setup == "write":
            _write_pdo(master, node, layout)
        _check_pdo(master, node, layout)
    if profile.file.pdo_setup == "write":
        _silence_others(master, profile, node)
    master.write(node, HEARTBEAT_TIME, round(1e3 * profile.heartbeat.drives))
    master.write_where_present(node, SYNC_PERIOD, round(1e6 * period))
    value, index = interpolation_period(period)
    if master.write_where_present(node, PERIOD_INDEX, index):
        master.write(node, PERIOD_VALUE, value)


def interpolation_period(period: float) -> tuple[int, int]:
    """Return Interpolation time period of ``period`` s: value and index, value * 10^index s.

    Raises InputError where one byte cannot hold it.
    """
    for index in (-3, -4, -5, -6, -2):  # ms first: some drives support nothing else
        value = period * 10.0**-index
        if 1.0 <= round(value) <= 255 and abs(value - round(value)) < 1e-6 * value:
            return round(value), index
    raise InputError(
        f"found {1.0 / period:g} SYNCs per second, expected a period of whole ms or tenths of it, "
        "as 100, 125, 200, 250, 500",
        ("link", "rate"),
    )


def _pdo(remote: Any, layout: PdoLayout) -> Any:
    return (remote.tpdo if layout.transmitted else remote.rpdo)[layout.number]


def _write_pdo(master: Master, node: int, layout: PdoLayout) -> None:
    def act(remote: Any) -> None:
        pdo = _pdo(remote, layout)
        pdo.read()
        pdo.clear()
        pdo.cob_id, pdo.enabled, pdo.trans_type = layout.cob_id(node), True, SYNCHRONOUS
        pdo.inhibit_time = pdo.event_timer = pdo.sync_start_value = None
        for entry in layout.entries:
            pdo.add_variable(entry.address.index, entry.address.subindex, entry.bits)
        pdo.save()

    master.sdo(node, f"the mapping of {layout.name}", act)


def _check_pdo(master: Master, node: int, layout: PdoLayout) -> None:
    """Read a PDO back and compare. Raises LinkError."""

    def act(remote: Any) -> Any:
        pdo = _pdo(remote, layout)
        pdo.read()
        return pdo

    pdo = master.sdo(node, f"the mapping of {layout.name}", act)
    mapped = [(Address(v.index, v.subindex), v.length) for v in pdo.map]
    wanted = [(entry.address, entry.bits) for entry in layout.entries]
    message = ""
    if mapped != wanted:
        message = f"maps {', '.join(str(a) for a, _ in mapped) or 'nothing'}"
    elif not pdo.enabled or pdo.cob_id != layout.cob_id(node):
        message = f"is {'at' if pdo.enabled else 'off at'} 0x{pdo.cob_id:X}"
    elif pdo.trans_type != SYNCHRONOUS:
        message = f"has transmission type {pdo.trans_type}"
    if message:
        raise LinkError(
            f"{master.where}: node {node}: {layout.name} {message}, expected "
            f"{', '.join(str(a) for a, _ in wanted)} at 0x{layout.cob_id(node):X}, type 1"
        )
    # the listener reads TPDOs by itself; the library's copy would only cost time
    if layout.cob_id(node) in master.network.subscribers:
        master.network.unsubscribe(layout.cob_id(node))


def _silence_others(master: Master, profile: CanopenProfile, node: int) -> None:
    """Disable the PDOs that the profile does not use."""
    for base, layouts in ((0x1800, profile.tpdo), (0x1400, profile.rpdo)):
        used = {layout.number for layout in layouts}
        for number in range(1, PDO_COUNT + 1):
            address = Address(base + number - 1, 1)
            if number in used:
                continue
            cob_id = master.read_where_present(node, address)
            if cob_id is not None and not cob_id & 1 << 31:
                master.write(node, address, cob_id | 1 << 31)
