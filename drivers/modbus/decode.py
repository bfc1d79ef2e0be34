"""Registers -> one sample, SI; no socket, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any, NamedTuple

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.modbus.encode import units_of
from gapbridge.drivers.modbus.map import RegisterMap, place_in
from gapbridge.drivers.modbus.profile import ECHO_WORDS, addresses, turns_of, vectors
from gapbridge.drivers.modbus.registers import BIT_TABLES, UNITS, Coding, words_in
from gapbridge.drivers.modbus.schema import Condition, Mailbox, Place, ProfileFile, Vector
from gapbridge.drivers.robot_modes import StopReason

Registers = Sequence[bytes]  # of each of RegisterMap.blocks, two bytes each, as on the wire
Spot = tuple[int, int, Coding]  # a number's block, its first register there, its coding

TURN = 2.0 * math.pi


class Sample(NamedTuple):
    """One reading of the blocks. A tuple, because one is created in every cycle."""

    vectors: dict[str, Array]  # by the profile's names, SI; echo (6,) m, rad: offset applied
    clock: float | None  # counts of the clock register
    stop_reasons: tuple[tuple[StopReason, str], ...]  # conditions that are not met
    motion: tuple[tuple[str, str], ...]  # of the last target: ("busy" or "result", message)
    answer: tuple[int, int] | None  # mailbox: sequence of the offset applied, program state


@dataclass(frozen=True, slots=True)
class _Field:
    """A vector compiled: where each of its numbers starts in its block."""

    name: str
    block: int  # of RegisterMap.blocks
    indices: tuple[int, ...]  # register indices in the block, all words of all numbers
    coding: Coding
    sizes: tuple[float, ...]  # SI units per count, of each number
    turn_block: int | None
    turn_indices: tuple[int, ...]
    turn_coding: Coding | None


class Decoder:
    """Decodes the blocks of one profile; each reading independently of those before."""

    def __init__(self, profile: ProfileFile, compiled: RegisterMap) -> None:
        self._map = compiled
        self._fields = [
            self._field(str(keys[1]), entry, count)
            for keys, _, entry, count in vectors(profile)
            if keys[0] == "state"
        ]
        self._answer: tuple[int, int] | None = None
        if isinstance(profile.write, Mailbox):
            self._fields.append(self._echo(profile.write))
        self._sizes = [(block, 2 * block.count) for block in compiled.blocks]
        self._conditions = [(self._spot(c), c) for c in profile.status]
        self._looked = _getters(spot for spot, _ in self._conditions)
        self._last_bytes: list[Any] = []  # bytes of the conditions, last time
        self._stop_reasons: tuple[tuple[StopReason, str], ...] = ()
        clock, write = profile.clock, profile.write
        self._motion: list[tuple[str, Spot, Condition]] = []
        if write.mode == "target_trigger":
            self._motion = [
                (name, self._spot(condition), condition)
                for name, condition in (("busy", write.busy), ("result", write.result))
                if condition is not None
            ]
        self._clock = self._spot(clock) if clock is not None else None
        self._again = (
            self._spot(clock.model_copy(update={"address": clock.again}))
            if clock is not None and clock.again is not None
            else None
        )

    def _field(self, name: str, entry: Vector, count: int) -> _Field:
        block, indices = self._indices(entry, count)
        turns = None if entry.turns is None else turns_of(entry, entry.turns)
        turn_block, turn_indices = (None, ()) if turns is None else self._indices(turns, count)
        return _Field(
            name, block, indices, entry.coding, (entry.scale * UNITS[entry.unit][1],) * count,
            turn_block, turn_indices, None if turns is None else turns.coding,
        )  # fmt: skip

    def _echo(self, box: Mailbox) -> _Field:
        """Return the field of the offset that the robot's program applies."""
        block, first = self._map.place_of(box.echo_table, box.echo_address, ECHO_WORDS)
        self._answer = (block, first)
        indices = tuple(range(first + 2, first + ECHO_WORDS))
        return _Field("echo", block, indices, Coding("i16"), units_of(box), None, (), None)

    def _indices(self, entry: Vector, count: int) -> tuple[int, tuple[int, ...]]:
        words = entry.coding.words
        places = addresses(entry, count)
        block, first = self._map.place_of(entry.table, places[0], words)
        return block, tuple(first + a - places[0] + k for a in places for k in range(words))

    def _spot(self, place: Place) -> Spot:
        coding = Coding("bit") if place.table in BIT_TABLES else place.coding
        return (*self._map.place_of(place.table, place.address, coding.words), coding)

    def decode(self, registers: Registers) -> Sample:
        """Return the sample in the registers of every block.

        Raises InvalidStateError if the sample is torn.
        """
        self._check_lengths(registers)
        clock = None if self._clock is None else _number(registers, self._clock)
        if self._again is not None and _number(registers, self._again) != clock:
            raise InvalidStateError(
                f"clock: found {clock:g} before and {_number(registers, self._again):g} after the "
                "sample, which is torn"
            )
        if clock is not None and not math.isfinite(clock):
            raise InvalidStateError(f"clock: found {clock:g}, expected a finite number")
        return Sample(
            {field.name: self._vector(field, registers) for field in self._fields},
            clock,
            self._stop_reasons_of(registers),
            tuple(
                (name, _words(condition, count))
                for name, spot, condition in self._motion
                if not condition.fine(count := int(_number(registers, spot)))
            ),
            None if self._answer is None else _answer_of(registers, *self._answer),
        )

    def _stop_reasons_of(self, registers: Registers) -> tuple[tuple[StopReason, str], ...]:
        """Return the conditions that are not met; evaluated again if a register has changed."""
        condition_bytes = [bytes_of(registers[block]) for block, bytes_of in self._looked]
        if condition_bytes != self._last_bytes:
            self._stop_reasons = tuple(
                (condition.otherwise, _words(condition, count))
                for spot, condition in self._conditions
                if not condition.fine(count := int(_number(registers, spot)))
            )
            self._last_bytes = condition_bytes
        return self._stop_reasons

    def _check_lengths(self, registers: Registers) -> None:
        for (block, size), data in zip(self._sizes, registers, strict=True):
            if len(data) != size:
                raise InvalidStateError(
                    f"{block.table} {block.first}: found {len(data) // 2} registers, expected "
                    f"{block.count}"
                )

    def _vector(self, field: _Field, registers: Registers) -> Array:
        counts = field.coding.decode(_picked(registers[field.block], field.indices))
        values = [count * size for count, size in zip(counts, field.sizes, strict=True)]
        if field.turn_block is not None and field.turn_coding is not None:
            turns = _picked(registers[field.turn_block], field.turn_indices)
            counts = field.turn_coding.decode(turns)
            values = [v + TURN * t for v, t in zip(values, counts, strict=True)]
        return np.array(values)


def _answer_of(registers: Registers, block: int, first: int) -> tuple[int, int]:
    number, program = words_in(registers[block], first, 2)
    return number, program


def _picked(data: bytes, indices: Sequence[int]) -> list[int]:
    return [data[2 * i] << 8 | data[2 * i + 1] for i in indices]


def _getters(spots: Iterable[Spot]) -> list[tuple[int, Callable[[bytes], Any]]]:
    """Return for each block a function that returns the bytes of its spots."""
    places: dict[int, list[int]] = {}
    for block, start, coding in spots:
        places.setdefault(block, []).extend(range(2 * start, 2 * (start + coding.words)))
    return [(block, itemgetter(*indices)) for block, indices in places.items()]


def check_identity(profile: ProfileFile, compiled: RegisterMap, registers: Registers) -> None:
    """Raise InvalidStateError for a controller that is not the profile's.

    ``registers`` are those of RegisterMap.identity.
    """
    for condition in profile.identity:
        coding = condition.coding
        where = place_in(compiled.identity, condition.table, condition.address, coding.words)
        count = int(_number(registers, (*where, coding)))
        if not condition.fine(count):
            raise InvalidStateError(f"{_words(condition, count)}: not the profile's controller")


def _number(registers: Registers, spot: Spot) -> float:
    block, start, coding = spot
    return coding.decode(words_in(registers[block], start, coding.words))[0]


def _words(condition: Condition, count: int) -> str:
    wanted = " or ".join(str(v) for v in condition.good)
    return (
        f"{condition.name} ({condition.table} {condition.address}): found {count}, expected "
        f"{wanted}"
    )
