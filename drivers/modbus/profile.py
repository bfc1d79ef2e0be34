"""Reading a register map and refusing an inconsistent one, with the line of the error."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gapbridge.drivers.modbus.registers import (
    BIT_TABLES,
    LAST_ADDRESS,
    MOST_REGISTERS,
    UNITS,
    Table,
)
from gapbridge.drivers.modbus.schema import (
    Condition,
    Place,
    ProfileFile,
    RegisterWrite,
    Turns,
    Vector,
)
from gapbridge.drivers.profile_file import (
    ProfileDocument,
    name_of,
    read_profile_file,
)

Keys = tuple[str | int, ...]
MAILBOX_WORDS, ECHO_WORDS = 11, 8
KINDS = {
    "position": "angle", "velocity": "speed", "target": "angle", "joint_torque": "torque",
    "temperature": "temperature", "force": "force", "moment": "torque",
}  # fmt: skip
THREE = ("force", "moment")


@dataclass(frozen=True, slots=True)
class Span:
    """Registers that one entry of the file uses."""

    keys: Keys
    table: Table
    first: int
    count: int

    @property
    def end(self) -> int:
        """Return the address after the last."""
        return self.first + self.count


def read_profile(path: Path, joints: int | None = None) -> ProfileFile:
    """Return the register map of a YAML file.

    ``joints`` is the number that the arm has; None: any. Raises ProfileError, one line that names
    file, line and key, what was found and what was expected.
    """
    document, profile = read_profile_file(path, ProfileFile)
    _check_vectors(document, profile)
    _check_places(document, profile)
    _check_overlap(document, profile)
    _check_readable(document, profile)
    document.require_joints(profile.joints, joints)
    return profile


def vectors(profile: ProfileFile) -> Iterator[tuple[Keys, str, Vector, int]]:
    """Yield keys, kind, entry and count of numbers of every vector in the file."""
    for name in KINDS:
        entry = getattr(profile.state, name)
        if entry is not None:
            yield ("state", name), KINDS[name], entry, 3 if name in THREE else profile.joints
    if profile.write.mode == "target_trigger":
        yield ("write", "target"), "angle", profile.write.target, profile.joints


def addresses(entry: Vector, count: int) -> list[int]:
    """Return the address of each number of a vector."""
    stride = entry.stride or entry.coding.words
    return [entry.address + i * stride for i in range(count)]


def turns_of(entry: Vector, turns: Turns) -> Vector:
    """Return the revolution counters of a vector as a vector of their own."""
    return Vector(table=entry.table, unit="turn", **turns.model_dump())


def single_places(profile: ProfileFile) -> Iterator[tuple[Keys, Place]]:
    """Yield every entry that is one number."""
    if profile.clock is not None:
        yield ("clock",), profile.clock
    for i, condition in enumerate(profile.status):
        yield ("status", i), condition
    for i, condition in enumerate(profile.identity):
        yield ("identity", i), condition
    write = profile.write
    if write.mode == "target_trigger":
        for name in ("before", "trigger", "stop"):
            for i, one in enumerate(getattr(write, name)):
                yield ("write", name, i), one
        for name in ("busy", "result"):
            if getattr(write, name) is not None:
                yield ("write", name), getattr(write, name)


def _check_vectors(document: ProfileDocument, profile: ProfileFile) -> None:
    for keys, kind, entry, _ in vectors(profile):
        if entry.scale == 0.0:
            raise document.error((*keys, "scale"), "found 0, expected a number other than zero")
        if entry.unit not in UNITS or UNITS[entry.unit][0] != kind:
            known = ", ".join(name for name, (what, _) in UNITS.items() if what == kind)
            raise document.error(
                (*keys, "unit"), f"found {entry.unit!r}, expected a unit of {kind}: {known}"
            )
        if entry.turns is not None and kind != "angle":
            raise document.error((*keys, "turns"), f"found turns of a {kind}, expected an angle")
        if entry.stride is not None and entry.stride < entry.coding.words:
            raise document.error(
                (*keys, "stride"),
                f"found {entry.stride}, expected {entry.coding.words} or more: the registers of "
                f"one {entry.type}",
            )


def _check_places(document: ProfileDocument, profile: ProfileFile) -> None:
    """Refuse tables that cannot hold a type, cannot be written, or end too early."""
    places = [(keys, entry) for keys, _, entry, _ in vectors(profile)]
    for keys, place in [*places, *single_places(profile)]:
        if place.table in BIT_TABLES and place.type not in ("bit", "u16"):
            raise document.error(
                (*keys, "type"), f"found {place.type!r} in table {place.table!r}, expected 'bit'"
            )
        if place.table not in BIT_TABLES and place.type == "bit":
            raise document.error(
                (*keys, "type"),
                f"found 'bit' in table {place.table!r}, expected a number's type, with a mask",
            )
        written = isinstance(place, RegisterWrite) or keys == ("write", "target")
        if written and place.table not in ("coil", "holding"):
            raise document.error(
                (*keys, "table"),
                f"found {place.table!r}, expected 'coil' or 'holding': others cannot be written",
            )
        if isinstance(place, Condition) and place.type.startswith("f"):
            raise document.error((*keys, "type"), f"found {place.type!r}, expected whole numbers")
        if isinstance(place, RegisterWrite):
            _check_write(document, keys, place)
    for span in spans(profile):
        if span.end - 1 > LAST_ADDRESS:
            raise document.error(
                (*span.keys, "address"), f"found {span.first}, whose last register is beyond 65535"
            )


def _check_readable(document: ProfileDocument, profile: ProfileFile) -> None:
    """Refuse a vector of the state that no single request can read: it would be torn."""
    state = [span for span in spans(profile) if span.keys[0] == "state"]
    mapped = {(s.table, address) for s in state for address in range(s.first, s.end)}
    vector_spans: dict[Keys, list[Span]] = {}
    for span in state:
        vector_spans.setdefault(span.keys, []).append(span)
    for keys, own in vector_spans.items():
        table, first, end = own[0].table, own[0].first, own[-1].end
        if end - first > MOST_REGISTERS:
            raise document.error(
                (*keys, "address"),
                f"found registers {first} to {end - 1}, expected at most {MOST_REGISTERS}: one "
                "request reads no more",
            )
        if not profile.gaps and any((table, a) not in mapped for a in range(first, end)):
            raise document.error(
                (*keys, "stride"),
                "found registers without a meaning between the numbers, which `gaps: false` "
                "forbids to read",
            )


def _check_write(document: ProfileDocument, keys: Keys, write: RegisterWrite) -> None:
    low, high = (0, 1) if write.table in BIT_TABLES else write.coding.limits
    if not low <= write.value <= high:
        raise document.error(
            (*keys, "value"), f"found {write.value:g}, expected {low:g} to {high:g}"
        )


def spans(profile: ProfileFile) -> list[Span]:
    """Return the registers of every entry."""
    result: list[Span] = []
    for keys, _, entry, count in vectors(profile):
        words = entry.coding.words
        result.extend(Span(keys, entry.table, a, words) for a in addresses(entry, count))
        if entry.turns is not None:
            turns = turns_of(entry, entry.turns)
            result.extend(
                Span((*keys, "turns"), entry.table, a, turns.coding.words)
                for a in addresses(turns, count)
            )
    result.extend(
        Span(keys, place.table, place.address, 1 if place.table in BIT_TABLES else words)
        for keys, place in single_places(profile)
        for words in (place.coding.words,)
    )
    if profile.clock is not None and profile.clock.again is not None:
        clock = profile.clock
        result.append(Span(("clock", "again"), clock.table, clock.again or 0, clock.coding.words))
    if profile.write.mode == "mailbox":
        box = profile.write
        result.append(Span(("write", "address"), box.table, box.address, MAILBOX_WORDS))
        result.append(Span(("write", "echo_address"), box.echo_table, box.echo_address, ECHO_WORDS))
    return result


def _check_overlap(document: ProfileDocument, profile: ProfileFile) -> None:
    """Refuse two entries on one register.

    Several conditions may read bits of one register, and several values may be written to one
    register; a target may be read back from where it is written.
    """
    ordered = sorted(spans(profile), key=lambda s: (s.table, s.first))
    for i, one in enumerate(ordered):
        for other in ordered[i + 1 :]:
            if other.table != one.table or other.first >= one.end:
                break
            if _may_share(one, other):
                continue
            low, high = sorted((one, other), key=lambda s: document.line(s.keys))
            place = high.keys[-1] if isinstance(high.keys[-1], str) else None
            keys = high.keys if place in ("address", "echo_address", "again") else (
                *high.keys, "address"
            )  # fmt: skip
            raise document.error(
                keys,
                f"found {high.table} registers {high.first} to {high.end - 1}, which overlap "
                f"{name_of(low.keys)} ({low.first} to {low.end - 1}, line "
                f"{document.line(low.keys)}), expected registers of their own",
            )


def _may_share(one: Span, other: Span) -> bool:
    same = (one.first, one.count) == (other.first, other.count)
    sets = {one.keys[0], other.keys[0]}
    conditions = sets <= {"status", "identity"}
    writes = sets == {"write"} and one.keys[1] != "target" and other.keys[1] != "target"
    echoed = {one.keys, other.keys} == {("write", "target"), ("state", "target")}
    watched = sets == {"status", "write"} and {"busy", "result"} & {*one.keys, *other.keys}
    return same and bool(conditions or writes or echoed or watched)
