"""Loading a CANopen profile from its YAML and its EDS, checked before a bus is opened."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from gapbridge.core.arrays import Array
from gapbridge.drivers.canopen.eds import Eds, read_eds
from gapbridge.drivers.canopen.objects import MODES, OBJECTS, Address, Mode
from gapbridge.drivers.canopen.pdo import Entry, PdoLayout
from gapbridge.drivers.profile_file import (
    ProfileDocument,
    ProfileError,
    read_profile_file,
)
from gapbridge.drivers.section import Number, Positive, Section

NodeId = Annotated[int, Field(ge=1, le=127, strict=True)]
PdoNumber = Annotated[int, Field(ge=1, le=4, strict=True)]
ObjectName = Annotated[str | int, Field(union_mode="left_to_right")]
Keys = tuple[str | int, ...]
MOST_BITS = 64
WINDOW = 0.7  # of the SYNC period: when TPDOs must have arrived, unless the profile says


class Joint(Section):
    """One drive and its joint."""

    node: NodeId = Field(description="node id")
    counts_per_turn: Positive = Field(description="position units in one turn before the gear")
    gear: Positive = Field(default=1.0, description="turns before the gear in one of the joint")
    direction: Literal[-1, 1] = Field(default=1, description="-1: counts fall as the joint rises")
    zero: Number = Field(default=0.0, description="rad that the joint stands at with count 0")
    rated_torque: Positive | None = Field(
        default=None, description="Nm at the joint where Torque actual value is 1000"
    )


class Heartbeat(Section):
    """Periods and timeouts of heartbeats."""

    drives: float = Field(
        default=0.1, ge=0.001, le=65.0, allow_inf_nan=False,
        description="s between two heartbeats of a drive",
    )  # fmt: skip
    lost_after: Positive = Field(default=0.3, description="s without one: the drive is lost")
    ours: Positive = Field(default=0.05, description="s between two heartbeats of ours")
    drives_wait: float = Field(
        default=0.25, ge=0.0, le=60.0, allow_inf_nan=False,
        description="s without ours after which an armed drive stops by itself; 0: it cannot",
    )  # fmt: skip
    our_node: NodeId = Field(default=127, description="our own node id")


class ProfileFile(Section):
    """The whole file."""

    name: str = Field(min_length=1, description="the arm")
    eds: str = Field(min_length=1, description="the drives' EDS or DCF, relative to this file")
    mode: Mode = Field(description="cyclic synchronous position, or interpolated position")
    sync_period: Positive = Field(default=0.01, description="s, the shortest between two SYNCs")
    sync_window: Positive | None = Field(
        default=None, description="s after a SYNC in which its TPDOs come; left out: 0.7 periods"
    )
    pdo_setup: Literal["write", "check"] = Field(
        default="write", description="check: the drives' PDOs are fixed and must be these"
    )
    confirms_mode: bool = Field(
        default=True, strict=True, description="Statusword bit 12: setpoints are followed"
    )
    velocity_scale: Positive | None = Field(
        default=None,
        description="position units/s in one Velocity actual value; left out: from positions",
    )
    heartbeat: Heartbeat = Heartbeat()
    tpdo: dict[PdoNumber, list[ObjectName]] = Field(
        min_length=1, description="TPDO number: its objects, in order"
    )
    rpdo: dict[PdoNumber, list[ObjectName]] = Field(
        min_length=1, description="RPDO number: its objects, in order"
    )
    joints: list[Joint] = Field(min_length=1, max_length=16, description="from base to flange")


@dataclass(frozen=True)
class CanopenProfile:
    """One arm's drives, checked. ``q = counts / counts_per_radian + zero``."""

    name: str
    path: Path
    eds: Eds
    file: ProfileFile
    nodes: tuple[int, ...]
    counts_per_radian: Array  # (n,), with the direction's sign
    zero: Array  # (n,) rad, at count 0
    tpdo: tuple[PdoLayout, ...]
    rpdo: tuple[PdoLayout, ...]

    @property
    def n(self) -> int:
        """Joints."""
        return len(self.nodes)

    @property
    def mode_number(self) -> int:
        """Return what Modes of operation must be."""
        return MODES[self.file.mode][0]

    @property
    def target(self) -> str:
        """Return the object that takes setpoints."""
        return MODES[self.file.mode][1]

    @property
    def heartbeat(self) -> Heartbeat:
        """Return periods and timeouts of heartbeats."""
        return self.file.heartbeat

    @property
    def rated_torque(self) -> Array | None:
        """Return (n,) Nm, None where a joint has none or no torque is mapped."""
        values = [joint.rated_torque for joint in self.file.joints]
        mapped = any(e.name == "Torque actual value" for pdo in self.tpdo for e in pdo.entries)
        known = [value for value in values if value is not None]
        return np.array(known) if mapped and len(known) == self.n else None

    @property
    def direction(self) -> Array:
        """Return (n,) of 1 and -1."""
        return np.sign(self.counts_per_radian)

    def angles(self, counts: Array) -> Array:
        """Return joint angles (n,), rad."""
        return counts / self.counts_per_radian + self.zero

    def counts(self, q: Array) -> Array:
        """Return the nearest whole position counts (n,) of joint angles, rad."""
        return np.rint((q - self.zero) * self.counts_per_radian)


def read_profile(path: Path, joints: int | None = None) -> CanopenProfile:
    """Return the profile of a YAML file.

    ``joints`` is the number that the arm has; None: any. Raises ProfileError, one line that names
    file, line and key, what was found and what was expected.
    """
    document, file = read_profile_file(path, ProfileFile)
    document.require_joints(len(file.joints), joints)
    _check_nodes(document, file)
    _check_times(document, file)
    try:
        eds = read_eds(path.parent / file.eds, file.joints[0].node)
    except ProfileError as error:
        raise document.error(("eds",), str(error)) from None
    pdos = _Pdos(document, eds)
    tpdo = pdos.layouts("tpdo", file.tpdo, ("Statusword", "Position actual value"))
    rpdo = pdos.layouts("rpdo", file.rpdo, ("Controlword", MODES[file.mode][1]))
    turn = 2.0 * np.pi
    per_radian = [j.direction * j.counts_per_turn * j.gear / turn for j in file.joints]
    return CanopenProfile(
        file.name, path, eds, file, tuple(j.node for j in file.joints),
        np.array(per_radian), np.array([j.zero for j in file.joints]), tpdo, rpdo,
    )  # fmt: skip


def _check_nodes(document: ProfileDocument, file: ProfileFile) -> None:
    our_node = file.heartbeat.our_node
    joint_of_node: dict[int, int] = {}
    for i, joint in enumerate(file.joints):
        keys: Keys = ("joints", i, "node")
        if joint.node in joint_of_node:
            raise document.error(
                keys, f"found {joint.node} again, expected one node per joint: joint "
                f"{joint_of_node[joint.node] + 1} has it",
            )  # fmt: skip
        if joint.node == our_node:
            raise document.error(
                keys, f"found {joint.node}, expected another than heartbeat.our_node"
            )
        joint_of_node[joint.node] = i


def _check_times(document: ProfileDocument, file: ProfileFile) -> None:
    beat = file.heartbeat
    if file.sync_window is not None and file.sync_window >= file.sync_period:
        raise document.error(
            ("sync_window",),
            f"found {file.sync_window:g} s, expected less than sync_period "
            f"({file.sync_period:g} s)",
        )
    pairs = [("lost_after", beat.lost_after, "drives", beat.drives)]
    if 0.0 < beat.drives_wait < 0.001:  # the object's unit is 1 ms, and 0 there is none
        raise document.error(
            ("heartbeat", "drives_wait"),
            f"found {beat.drives_wait:g} s, expected 0 or at least 0.001 s",
        )
    if beat.drives_wait:
        pairs.append(("drives_wait", beat.drives_wait, "ours", beat.ours))
    for key, wait, other, period in pairs:
        if wait < 1.5 * period:
            raise document.error(
                ("heartbeat", key),
                f"found {wait:g} s, expected at least 1.5 times heartbeat.{other} ({period:g} s)",
            )


@dataclass(frozen=True)
class _Pdos:
    """The PDO maps of one profile, looked up in its EDS."""

    document: ProfileDocument
    eds: Eds

    def layouts(
        self, key: str, names_of_pdo: Mapping[int, Sequence[str | int]], wanted: tuple[str, ...]
    ) -> tuple[PdoLayout, ...]:
        """Return the layouts of a section; refuses missing, repeated or too long ones."""
        layouts: list[PdoLayout] = []
        keys_of_name: dict[str, Keys] = {}
        for number, names in sorted(names_of_pdo.items()):
            entries = []
            for i, name in enumerate(names):
                keys: Keys = (key, str(number), i)
                entry = self._entry(keys, name, key == "tpdo")
                if entry.name in keys_of_name:
                    line = self.document.line(keys_of_name[entry.name])
                    raise self.document.error(
                        keys, f"found {entry.name!r} again (line {line}), expected it once"
                    )
                keys_of_name[entry.name] = keys
                entries.append(entry)
            bits = sum(entry.bits for entry in entries)
            if not 0 < bits <= MOST_BITS:
                raise self.document.error(
                    (key, str(number)), f"found {bits} bits, expected 1 to {MOST_BITS}"
                )
            layouts.append(PdoLayout(number, tuple(entries), key == "tpdo"))
        for name in wanted:
            if name not in keys_of_name:
                raise self.document.error((key,), f"found no {name!r}, expected it in a PDO")
        return tuple(layouts)

    def _entry(self, keys: Keys, name: str | int, transmitted: bool) -> Entry:
        address = self._address(keys, name)
        called = next(
            (known for known, known_address in OBJECTS.items() if known_address == address),
            str(address),
        )
        variable = self.eds.variable(address)
        if variable is None:
            raise self.document.error(
                keys, f"found {called!r}, expected an object of {self.eds.path.name} ({address})"
            )
        if not variable.mappable or not (variable.readable if transmitted else variable.writable):
            kind = "TPDO" if transmitted else "RPDO"
            raise self.document.error(
                keys, f"found {called!r}, which {self.eds.path.name} allows in no {kind}"
            )
        return Entry(called, address, variable.bits, variable.signed)

    def _address(self, keys: Keys, name: str | int) -> Address:
        if isinstance(name, str):
            for known, address in OBJECTS.items():
                if known.lower() == name.lower():
                    return address
        index, _, subindex = (hex(name) if isinstance(name, int) else name).partition(":")
        try:
            if not index.startswith("0x"):
                raise ValueError
            address = Address(int(index, 16), int(subindex or "0", 0))
        except ValueError:
            raise self.document.error(
                keys, f"found {name!r}, expected an object's name{_near(str(name), OBJECTS)}, or "
                "its address as 0x2001 or 0x2001:3",
            ) from None  # fmt: skip
        if not (0x1000 <= address.index <= 0xFFFF and 0 <= address.subindex <= 0xFF):
            raise self.document.error(keys, f"found {name!r}, expected 0x1000 to 0xFFFF")
        return address


def _near(name: str, known: Mapping[str, object] | Sequence[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" (did you mean {near[0]!r}?)" if near else ""
