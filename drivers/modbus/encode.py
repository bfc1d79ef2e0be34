"""Numbers -> registers: joint targets, the mailbox's eleven registers, and a vector's whole row."""

from __future__ import annotations

import math
from collections.abc import Sequence
from operator import mul

from gapbridge.drivers.modbus.profile import addresses, turns_of
from gapbridge.drivers.modbus.registers import UNITS, Coding
from gapbridge.drivers.modbus.schema import Mailbox, Vector

SEQUENCES = 0x8000  # sequence numbers and heartbeats run from 1 to this less one; 0: nothing sent
MODULUS, SEED = 65521, 0x4742  # of the checksum: the largest prime below 65536

LARGEST = 0x7FFF  # counts
RATE_COUNTS = 2.0e-5, 1.0e-4  # m/s and rad/s per count of the cell's rates

ABSENT, RUNNING, EXPIRED, REJECTED = 0, 1, 2, 3  # state that the robot's program reports


def next_number(number: int) -> int:
    """Return the sequence number or heartbeat after ``number``."""
    return number % (SEQUENCES - 1) + 1


def checksum(words: Sequence[int]) -> int:
    """Return the checksum of registers: a weighted sum, so that order and loss both show."""
    total: int = sum(map(mul, words, range(1, len(words) + 1)))
    return (SEED + total) % MODULUS


def offset_counts(units: Sequence[float], offset_in_base: Sequence[float]) -> list[int]:
    """Return an offset (6,), m and rad, as signed counts of ``units_of`` the mailbox.

    Raises ValueError for one that is not finite or does not fit 16 bits.
    """
    counts: list[int] = []
    for i, (value, unit) in enumerate(zip(offset_in_base, units, strict=True)):
        if not math.isfinite(value) or abs(count := round(value / unit)) > LARGEST:
            raise ValueError(
                f"found an offset of {value:g} {'m' if i < 3 else 'rad'}, expected at most "
                f"{LARGEST * unit:g}: what 16 bits hold"
            )
        counts.append(count)
    return counts


def units_of(box: Mailbox) -> tuple[float, ...]:
    """Return m or rad per count of an offset's six numbers."""
    return (box.length_count,) * 3 + (box.angle_count,) * 3


def rate_counts(rates: Sequence[float]) -> list[int]:
    """Return the cell's rates, m/s and rad/s, in counts, rounded down: the program is no faster.

    Raises ValueError for what rounds down to nothing.
    """
    counts: list[int] = []
    for name, rate, count in zip(
        ("offset_rate", "offset_rotation_rate"), rates, RATE_COUNTS, strict=True
    ):
        counts.append(min(int(rate / count * (1.0 + 1e-9)), 0xFFFF))
        if counts[-1] < 1:
            raise ValueError(f"{name}: found {rate:g}, expected {count:g} at least")
    return counts


def mailbox_words(
    sequence: int, counts: Sequence[int], heartbeat: int, rates: Sequence[int]
) -> list[int]:
    """Return the eleven registers of a mailbox: sequence, offset, heartbeat, rates, checksum."""
    words = [sequence, *[c & 0xFFFF for c in counts], heartbeat, *rates]
    return [*words, checksum(words)]


def offset_of(box: Mailbox, words: Sequence[int]) -> list[float]:
    """Return the offset (6,), m and rad, in six registers."""
    counts = Coding("i16").decode(words)
    return [count * unit for count, unit in zip(counts, units_of(box), strict=True)]


def vector_registers(entry: Vector, values: Sequence[float]) -> dict[int, int]:
    """Return address -> register for the numbers of a vector, SI.

    Raises ValueError where one does not fit.
    """
    size = entry.scale * UNITS[entry.unit][1]
    registers: dict[int, int] = {}
    angles = list(values)
    if entry.turns is not None:
        turns = [math.floor(v / (2.0 * math.pi)) for v in values]
        angles = [v - 2.0 * math.pi * t for v, t in zip(values, turns, strict=True)]
        _place(registers, turns_of(entry, entry.turns), [float(t) for t in turns])
    _place(registers, entry, [v / size for v in angles])
    return registers


def _place(registers: dict[int, int], entry: Vector, counts: Sequence[float]) -> None:
    coding = entry.coding
    words, size = coding.encode(counts), coding.words
    for i, address in enumerate(addresses(entry, len(counts))):
        for k in range(size):
            registers[address + k] = words[i * size + k]


def runs(registers: dict[int, int]) -> list[tuple[int, list[int]]]:
    """Return registers as unbroken runs: first address and words."""
    result: list[tuple[int, list[int]]] = []
    for address in sorted(registers):
        if result and address == result[-1][0] + len(result[-1][1]):
            result[-1][1].append(registers[address])
        else:
            result.append((address, [registers[address]]))
    return result
