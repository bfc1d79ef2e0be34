"""One PDO's layout: bytes <-> the counts of its objects."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from gapbridge.drivers.canopen.objects import PDO_STEP, RPDO_BASE, TPDO_BASE, Address


@dataclass(frozen=True, slots=True)
class Entry:
    """One object mapped into a PDO."""

    name: str
    address: Address
    bits: int
    signed: bool

    @property
    def low(self) -> int:
        """Return the smallest count."""
        return -(1 << (self.bits - 1)) if self.signed else 0

    @property
    def high(self) -> int:
        """Return the largest count."""
        return (1 << (self.bits - self.signed)) - 1


@dataclass(frozen=True)
class PdoLayout:
    """One of the four TPDOs or RPDOs of each drive, little-endian, bit after bit."""

    number: int  # from 1
    entries: tuple[Entry, ...]
    transmitted: bool  # True: a TPDO

    @cached_property
    def length(self) -> int:
        """Return how many bytes it has."""
        return (sum(entry.bits for entry in self.entries) + 7) // 8

    @property
    def name(self) -> str:
        """Return how messages call it."""
        return f"{'TPDO' if self.transmitted else 'RPDO'}{self.number}"

    def cob_id(self, node: int) -> int:
        """Return its identifier at a node, that of the predefined connection set."""
        base = TPDO_BASE if self.transmitted else RPDO_BASE
        return base + PDO_STEP * (self.number - 1) + node

    @cached_property
    def _fields(self) -> tuple[tuple[str, int, int, int], ...]:
        """Return name, bits, smallest and largest count of each object; used in each cycle."""
        return tuple((entry.name, entry.bits, entry.low, entry.high) for entry in self.entries)

    def decode(self, data: bytes) -> dict[str, int]:
        """Return the counts by object name. Raises ValueError where the length is another."""
        if len(data) != self.length:
            raise ValueError(f"{self.name}: found {len(data)} bytes, expected {self.length}")
        whole, counts = int.from_bytes(data, "little"), {}
        for name, bits, _, high in self._fields:
            value = whole & ((1 << bits) - 1)
            counts[name] = value - (1 << bits) if value > high else value
            whole >>= bits
        return counts

    def encode(self, counts: dict[str, int]) -> bytes:
        """Return the bytes. Raises ValueError where a count does not fit."""
        whole, start = 0, 0
        for name, bits, low, high in self._fields:
            value = counts[name]
            if not low <= value <= high:
                raise ValueError(f"{name}: found {value}, expected {low} to {high}")
            whole |= (value & ((1 << bits) - 1)) << start
            start += bits
        return whole.to_bytes(self.length, "little")
