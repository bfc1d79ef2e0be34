"""The registers of a simulated controller: its state in the profile's layout."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gapbridge.drivers.modbus.encode import vector_registers
from gapbridge.drivers.modbus.profile import addresses, spans, turns_of
from gapbridge.drivers.modbus.registers import BIT_TABLES, UNITS, Table
from gapbridge.drivers.modbus.schema import Clock, Condition, Place, ProfileFile, Vector
from gapbridge.drivers.robot_modes import StopReason
from gapbridge.drivers.simulated.server.arm_controller import ArmController

Image = dict[Table, dict[int, int]]
TABLES: tuple[Table, ...] = ("coil", "discrete", "holding", "input")


def blank(profile: ProfileFile) -> Image:
    """Return every register of a profile, zero, and those in between, which read as zero too."""
    image: Image = {table: {} for table in TABLES}
    for span in spans(profile):
        image[span.table].update(dict.fromkeys(range(span.first, span.end), 0))
    for table, registers in image.items():
        if registers and (profile.gaps or table in BIT_TABLES):
            image[table] = dict.fromkeys(range(min(registers), max(registers) + 1), 0)
    return image


def readings(controller: ArmController) -> dict[str, Sequence[float]]:
    """Return the state by the profile's names, SI."""
    return {
        "position": controller.q, "velocity": controller.qd, "target": controller.target_q,
        "joint_torque": controller.joint_torque, "temperature": controller.temperatures,
        "force": controller.tcp_force[:3], "moment": controller.tcp_force[3:],
    }  # fmt: skip


def state_registers(profile: ProfileFile, values: dict[str, Sequence[float]]) -> Image:
    """Return the registers of a state. Numbers that do not fit are cut off, as firmware does."""
    image: Image = {table: {} for table in TABLES}
    for name, numbers in values.items():
        entry: Vector | None = getattr(profile.state, name)
        if entry is not None:
            image[entry.table].update(vector_registers(entry, _cut(entry, numbers)))
    return image


def _cut(entry: Vector, numbers: Sequence[float]) -> list[float]:
    if entry.turns is not None:
        return list(numbers)
    size = entry.scale * UNITS[entry.unit][1]
    low, high = sorted(limit * size for limit in entry.coding.limits)
    return [min(max(v, low), high) for v in numbers]


def condition_registers(
    conditions: Iterable[Condition], active: frozenset[StopReason]
) -> list[tuple[Table, int, int]]:
    """Return table, address and register of conditions: fine, unless their stop is active."""
    registers: dict[tuple[Table, int], int] = {}
    for condition in conditions:
        spot = (condition.table, condition.address)
        value = bad(condition) if condition.otherwise in active else condition.good[0]
        mask = 0xFFFF if condition.mask is None else condition.mask
        registers[spot] = registers.get(spot, 0) & ~mask | value & mask
    return [(table, address, value) for (table, address), value in registers.items()]


def bad(condition: Condition) -> int:
    """Return a count that does not meet a condition."""
    steps = range(0xFFFF) if condition.mask is None else [0, condition.mask]
    return next(count for count in steps if not condition.fine(count))


def clock_registers(profile: ProfileFile, seconds: float) -> list[tuple[Table, int, int]]:
    """Return the registers of the controller's clock at ``seconds``, its repetition included."""
    clock = profile.clock
    if clock is None:
        return []
    count = clock_count(clock, seconds, profile.period)
    registers = place_registers(clock, count)
    if clock.again is not None:
        registers += place_registers(clock.model_copy(update={"address": clock.again}), count)
    return registers


def clock_count(clock: Clock, seconds: float, period: float) -> float:
    """Return the counts of a clock register, which wraps at the range of its type."""
    if clock.kind == "timestamp":
        count = seconds / (clock.scale * UNITS[clock.unit][1])
    else:
        count = round(seconds / period / (clock.scale if clock.kind == "counter" else 1.0))
    if clock.type.startswith("f"):
        return count
    low, high = clock.coding.limits
    return float(int(count) % int(high - low + 1) + int(low))


def place_registers(place: Place, count: float) -> list[tuple[Table, int, int]]:
    """Return table, address and register of one number."""
    if place.table in BIT_TABLES:
        return [(place.table, place.address, int(count))]
    words = place.coding.encode([count])
    return [(place.table, place.address + k, word) for k, word in enumerate(words)]


def tear(profile: ProfileFile, image: Image, other: Image) -> None:
    """Mix the joints of two moments in one image, as when a controller is read while it writes.

    The second half of the joints' registers, and of each longer number, is of the other moment;
    a clock's repetition is too.
    """
    entry = profile.state.position
    places = [entry] if entry.turns is None else [entry, turns_of(entry, entry.turns)]
    for place in places:
        words = place.coding.words
        for i, address in enumerate(addresses(place, profile.joints)):
            late = range(words) if i >= profile.joints // 2 else range(words // 2)
            for k in late:
                image[entry.table][address + k] = other[entry.table][address + k]
    if profile.clock is not None and profile.clock.again is not None:
        for k in range(profile.clock.coding.words):
            address = profile.clock.again + k
            image[profile.clock.table][address] = (image[profile.clock.table][address] + 1) % 65536
