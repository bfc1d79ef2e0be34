"""Numbers in 16-bit registers: types, word order, sign coding, units.

Bytes within a register are high byte first on every Modbus wire; only the order of the words of a
longer number differs from controller to controller.
"""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Table = Literal["coil", "discrete", "holding", "input"]
TypeName = Literal["bit", "i16", "u16", "i32", "u32", "i64", "u64", "f32", "f64", "sm16", "sm32"]
WordOrder = Literal["high_first", "low_first"]

BIT_TABLES = ("coil", "discrete")
MOST_REGISTERS = 125  # that one request can read
LAST_ADDRESS = 65535

CODES = {
    "i16": "h", "u16": "H", "i32": "i", "u32": "I", "i64": "q", "u64": "Q", "f32": "f", "f64": "d",
    "sm16": "H", "sm32": "I",
}  # fmt: skip
"""Type -> code of Python's struct; sm is sign and magnitude: the top bit is the sign."""
WORDS = {name: struct.calcsize(f">{code}") // 2 for name, code in CODES.items()} | {"bit": 1}
"""Registers (or bits) that one number of a type takes."""

UNITS: dict[str, tuple[str, float]] = {
    "rad": ("angle", 1.0), "mrad": ("angle", 1e-3), "deg": ("angle", math.pi / 180.0),
    "turn": ("angle", 2.0 * math.pi),
    "rad/s": ("speed", 1.0), "mrad/s": ("speed", 1e-3), "deg/s": ("speed", math.pi / 180.0),
    "N": ("force", 1.0), "Nm": ("torque", 1.0), "degC": ("temperature", 1.0),
    "A": ("current", 1.0), "mA": ("current", 1e-3),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "count": ("count", 1.0),
    "m": ("length", 1.0), "mm": ("length", 1e-3),
}  # fmt: skip
"""Unit -> what it measures, and its size in SI units."""


def words_in(data: bytes, first: int, count: int) -> tuple[int, ...]:
    """Return registers out of bytes as they came over the wire."""
    return struct.unpack_from(f">{count}H", data, 2 * first)


def wire_of(words: Sequence[int]) -> bytes:
    """Return registers (or bits, 0 and 1) as bytes; struct.error for one beyond 16 bits."""
    return struct.pack(f">{len(words)}H", *words)


@functools.cache
def _limits(name: TypeName) -> tuple[float, float]:
    bits = 16 * WORDS[name]
    if name == "bit":
        return 0.0, 1.0
    if name.startswith("f"):
        most = 3.4e38 if name == "f32" else 1.7e308
        return -most, most
    if name.startswith("sm"):
        return -(2.0 ** (bits - 1) - 1), 2.0 ** (bits - 1) - 1
    if name.startswith("i"):
        return -(2.0 ** (bits - 1)), 2.0 ** (bits - 1) - 1
    return 0.0, 2.0**bits - 1


@dataclass(frozen=True, slots=True)
class Coding:
    """How numbers of one kind are coded in registers."""

    type: TypeName
    order: WordOrder = "high_first"

    @property
    def words(self) -> int:
        """Return the registers of one number."""
        return WORDS[self.type]

    @property
    def limits(self) -> tuple[float, float]:
        """Return the smallest and the largest count that fits; floats: their range."""
        return _limits(self.type)

    def decode(self, registers: Sequence[int]) -> Sequence[float]:
        """Return the numbers in registers (words a number), as counts."""
        if self.type in ("bit", "u16"):  # most registers are these: no packing for them
            return registers
        if self.type == "i16":
            return [v - 0x10000 if v & 0x8000 else v for v in registers]
        words, count = self.words, len(registers) // self.words
        data = struct.pack(f">{len(registers)}H", *self._ordered(registers))
        values = struct.unpack(f">{count}{CODES[self.type]}", data)
        if self.type.startswith("sm"):
            top = 1 << (16 * words - 1)
            return [-(v & ~top) if v & top else v for v in values]
        return list(values)

    def encode(self, counts: Sequence[float]) -> list[int]:
        """Return the registers of numbers given as counts; integers are rounded.

        Raises ValueError for one that is not finite or does not fit.
        """
        low, high = self.limits
        for value in counts:
            if not math.isfinite(value) or not low - 0.5 <= value <= high + 0.5:
                raise ValueError(f"found {value:g} counts, expected {low:g} to {high:g}")
        if self.type == "bit":
            return [int(bool(v)) for v in counts]
        if self.type.startswith("f"):
            data = struct.pack(f">{len(counts)}{CODES[self.type]}", *counts)
        else:
            data = struct.pack(
                f">{len(counts)}{CODES[self.type]}", *(self._integer(v) for v in counts)
            )
        return list(self._ordered(struct.unpack(f">{len(data) // 2}H", data)))

    def _integer(self, value: float) -> int:
        low, high = self.limits
        count = min(max(round(value), int(low)), int(high))
        if self.type.startswith("sm") and count < 0:
            return -count | 1 << (16 * self.words - 1)
        return count

    def _ordered(self, registers: Sequence[int]) -> Sequence[int]:
        """Return registers with the words of each number reversed if the low one is first."""
        words = self.words
        if words == 1 or self.order == "high_first":
            return registers
        turned = [0] * len(registers)
        for k in range(words):
            turned[k::words] = registers[words - 1 - k :: words]
        return turned
