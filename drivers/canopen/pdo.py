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

    def decode(self, data: bytes) -> dict[str, int]:
        """Return the counts by object name. Raises ValueError where the length is another."""
        if len(data) != self.length:
            raise ValueError(f"{self.name}: found {len(data)} bytes, expected {self.length}")
        whole, counts = int.from_bytes(data, "little"), {}
        for entry in self.entries:
            value = whole & ((1 << entry.bits) - 1)
            counts[entry.name] = value - (1 << entry.bits) if value > entry.high else value
            whole >>= entry.bits
        return counts

    def encode(self, counts: dict[str, int]) -> bytes:
        """Return the bytes. Raises ValueError where a count does not fit."""
        whole, start = 0, 0
        for entry in self.entries:
            value = counts[entry.name]
            if not entry.low <= value <= entry.high:
                raise ValueError(
                    f"{entry.name}: found {value}, expected {entry.low} to {entry.high}"
                )
            whole |= (value & ((1 << entry.bits) - 1)) << start
            start += entry.bits
        return whole.to_bytes(self.length, "little")
