"""The master of the drives on a bus: NMT, SDO, SYNC and RPDOs by the canopen library.

The library's heartbeat callbacks, SDO client and notifier thread are used as they are; its p402
setters are not, because each blocks for up to a second.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable
from typing import Any

import canopen

from gapbridge.core.errors import LinkError, WriteError, first_line
from gapbridge.drivers.can_bus.bus import close_bus, open_bus
from gapbridge.drivers.canopen.listening import BusListener, HeartbeatMonitor
from gapbridge.drivers.canopen.objects import (
    HEARTBEAT_BASE,
    NMT,
    PDO_COUNT,
    SDO_REQUEST_BASE,
    SYNC,
    Address,
)
from gapbridge.drivers.canopen.profile import CanopenProfile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.sync_set import SyncCollector
from gapbridge.drivers.clock import Clock

logging.getLogger("canopen").setLevel(logging.CRITICAL)  # reported by our own errors instead
ABSENT = (0x06020000, 0x06090011)  # SDO aborts: no such object, no such subindex
OPERATIONAL_STATE = 5
ALWAYS: tuple[Address, ...] = (
    Address(0x1006, 0),  # SYNC period
    Address(0x1016, 1),  # consumer heartbeat: the drives watch us
    Address(0x1017, 0),  # producer heartbeat
    Address(0x6007, 0),  # abort connection option
    Address(0x6060, 0),  # modes of operation
    Address(0x60C2, 1),  # interpolation period
    Address(0x60C2, 2),
)
PDO_SETUP = (0x1400, 0x1600, 0x1800, 0x1A00)  # communication and mapping, of RPDOs and TPDOs
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 1, 2, 3, 4  # SDO client command specifiers


class _Network(canopen.Network):
    """The library's network, which sends only allowed frames, and whose thread ends soon."""

    NOTIFIER_CYCLE = 0.05
    NOTIFIER_SHUTDOWN_TIMEOUT = 1.0

    def __init__(self, bus: Any, allowed: AllowedFrames) -> None:
        super().__init__(bus)
        self._allowed = allowed

    def send_message(self, can_id: int, data: Any, remote: bool = False) -> None:
        """Send a frame that the profile allows; the library sends all frames through here."""
        self._allowed.check(can_id, data)
        super().send_message(can_id, data, remote)


class Master:
    """The only master of one profile's drives, on one bus."""

    def __init__(self, settings: CanopenSettings, profile: CanopenProfile, clock: Clock) -> None:
        self.clock = clock
        self._settings, self._profile = settings, profile
        self.collector = SyncCollector(profile, clock)
        self.network: Any = None
        self.listener: BusListener | None = None
        self.heartbeats: HeartbeatMonitor | None = None
        self._beat_at = 0.0  # s, monotonic: when our next heartbeat is due

    @property
    def where(self) -> str:
        """Return the name of the link in messages."""
        return f"{self._settings.where()}: {self._profile.name}"

    def open(self) -> None:
        """Open the bus and listen; sends nothing. Raises LinkError."""
        self._listen(_Network(open_bus(self._settings), AllowedFrames(self._profile)))

    def _listen(self, network: Any) -> None:
        self.listener = BusListener(
            network, self._settings, self._profile, self.collector, self.clock
        )
        network.listeners[:] = [self.listener]
        for node in self._profile.nodes:
            remote = network.add_node(node, self._profile.eds.dictionary(node))
            remote.sdo.RESPONSE_TIMEOUT = self._settings.sdo_timeout
        self.heartbeats = HeartbeatMonitor(network, self._profile, self.clock)
        self._beat_at = 0.0
        network.connect()
        self.network = network

    def close(self) -> None:
        """Close the bus; may be repeated."""
        network, self.network = self.network, None
        if network is None:
            return
        bus = network.bus
        with contextlib.suppress(Exception):  # disconnect raises what had ended the thread
            network.disconnect()
        close_bus(bus)

    def check(self) -> None:
        """Raise LinkError if the bus, or the thread that reads it, has ended."""
        if self.network is None:
            raise LinkError(f"{self.where}: found no bus, expected connect() first")
        try:
            self.network.check()
        except Exception as error:
            raise LinkError(f"{self.where}: {first_line(error)}") from None

    # -- frames -----------------------------------------------------------------------------------

    def send(self, cob_id: int, data: bytes, what: str) -> None:
        """Send one frame. Raises LinkError."""
        self.check()
        try:
            self.network.send_message(cob_id, data)
        except Exception as error:  # CanError, OSError, serial's
            raise LinkError(
                f"{self.where}: {what} could not be sent: {first_line(error)}"
            ) from None

    def sync(self) -> float:
        """Send one SYNC, and our heartbeat if due; returns when it was sent (s, monotonic)."""
        self.beat()
        now = self.clock.monotonic()
        self.collector.begin(now)
        self.send(SYNC, b"", "SYNC")
        return now

    def beat(self) -> None:
        """Send our heartbeat if due. Called by the loop, so that it stops if the loop hangs."""
        now = self.clock.monotonic()
        if now < self._beat_at:
            return
        self._beat_at = now + 0.5 * self._profile.heartbeat.ours
        cob_id = HEARTBEAT_BASE + self._profile.heartbeat.our_node
        self.send(cob_id, bytes([OPERATIONAL_STATE]), "heartbeat")

    def command(self, node: int, state: str) -> None:
        """Send an NMT command to one node: OPERATIONAL, PRE-OPERATIONAL. Raises LinkError."""
        self.check()
        try:
            self.network[node].nmt.state = state
        except Exception as error:
            raise LinkError(f"{self.where}: node {node}: {first_line(error)}") from None

    # -- objects ----------------------------------------------------------------------------------

    def sdo(self, node: int, what: str, act: Callable[[Any], Any]) -> Any:
        """Return what ``act`` does with a node of the library. Raises LinkError.

        ``what`` is named in messages.
        """
        self.check()
        try:
            return act(self.network[node])
        except canopen.SdoAbortedError as error:
            raise LinkError(
                f"{self.where}: node {node} refuses {what}: SDO abort 0x{error.code:08X}"
            ) from None
        except canopen.SdoCommunicationError:
            raise LinkError(f"{self.where}: node {node} does not answer ({what})") from None
        except Exception as error:  # an answer that no SDO server gives
            raise LinkError(f"{self.where}: node {node}: {what}: {first_line(error)}") from None

    def read(self, node: int, address: Address) -> int:
        """Return one object's value. Raises LinkError."""
        return int(self.sdo(node, str(address), lambda n: _variable(n, address).raw))

    def write(self, node: int, address: Address, value: int) -> None:
        """Write one object. Raises LinkError."""

        def act(remote: Any) -> None:
            _variable(remote, address).raw = value

        self.sdo(node, str(address), act)

    def read_where_present(self, node: int, address: Address) -> int | None:
        """Return an object's value, None if the EDS or the drive has none. Raises LinkError."""
        if not self._profile.eds.has(address):
            return None

        def act(remote: Any) -> int | None:
            try:
                return int(_variable(remote, address).raw)
            except canopen.SdoAbortedError as error:
                if error.code in ABSENT:
                    return None
                raise

        value: int | None = self.sdo(node, str(address), act)
        return value

    def write_where_present(self, node: int, address: Address, value: int) -> bool:
        """Write an object that a drive may lack; returns whether it has it. Raises LinkError."""
        if self.read_where_present(node, address) is None:
            return False
        self.write(node, address, value)
        return True


def _variable(remote: Any, address: Address) -> Any:
    entry = remote.sdo[address.index]
    return entry[address.subindex] if hasattr(entry, "__getitem__") else entry


class AllowedFrames:
    """The allow-list of one profile: identifiers, NMT nodes, objects that SDOs may write.

    It contains no object of a drive's limits, gains, offsets or identity, no node outside the
    profile, and no NMT command to all nodes.
    """

    def __init__(self, profile: CanopenProfile) -> None:
        self._name = profile.name
        self._nodes = frozenset(profile.nodes)
        self._plain = frozenset(
            {SYNC, HEARTBEAT_BASE + profile.heartbeat.our_node}
            | {layout.cob_id(node) for layout in profile.rpdo for node in profile.nodes}
        )
        self._sdo = frozenset(SDO_REQUEST_BASE + node for node in profile.nodes)
        self._indices = frozenset(
            base + number
            for base in (PDO_SETUP if profile.file.pdo_setup == "write" else ())
            for number in range(PDO_COUNT)
        )

    def check(self, cob_id: int, data: bytes) -> None:
        """Raise WriteError for a frame that the profile does not allow."""
        if cob_id in self._plain:
            return
        if cob_id in self._sdo:
            self._check_sdo(bytes(data), cob_id - SDO_REQUEST_BASE)
        elif cob_id != NMT or len(data) != 2 or data[1] not in self._nodes:
            raise WriteError(
                f"{self._name}: frame 0x{cob_id:03X} {bytes(data).hex(' ')}: the profile does not "
                "allow it to be sent"
            )

    def _check_sdo(self, data: bytes, node: int) -> None:
        command = data[0] >> 5 if data else -1
        if command in (_UPLOAD, _UPLOAD_SEGMENT, _ABORT):
            return
        address = Address(int.from_bytes(data[1:3], "little"), data[3] if len(data) > 3 else 0)
        if command == _DOWNLOAD and (address in ALWAYS or address.index in self._indices):
            return
        raise WriteError(
            f"{self._name}: node {node}: {address}: the profile does not allow it to be written"
        )
