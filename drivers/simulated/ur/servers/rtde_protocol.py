"""RTDE frames: requests and replies as bytes, recipes as pre-packed encoders.

Source: Universal Robots, 'Real-Time Data Exchange (RTDE) Guide', and the project's measurements of
what clients send. All numbers are big-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gapbridge.drivers.simulated.ur.rtde_names import FORMATS, INPUTS, OUTPUTS

REQUEST_VERSION = ord("V")
CONTROLLER_VERSION = ord("v")
TEXT = ord("M")
DATA = ord("U")
SETUP_OUTPUTS = ord("O")
SETUP_INPUTS = ord("I")
START = ord("S")
PAUSE = ord("P")

HEADER = struct.Struct(">HB")


class FrameError(ValueError):
    """A byte stream that cannot be RTDE: the connection has to be closed."""


def frame(kind: int, payload: bytes) -> bytes:
    """Return one RTDE frame of type `kind`."""
    return HEADER.pack(HEADER.size + len(payload), kind) + payload


def take_frame(buffer: bytearray) -> tuple[int, bytes] | None:
    """Remove and return the first whole frame of `buffer` as (type, payload); None if incomplete.

    Raises FrameError for a size field smaller than a header.
    """
    if len(buffer) < HEADER.size:
        return None
    size, kind = HEADER.unpack_from(buffer)
    if size < HEADER.size:
        raise FrameError(f"RTDE frame with a size field of {size}")
    if len(buffer) < size:
        return None
    payload = bytes(buffer[HEADER.size : size])
    del buffer[:size]
    return kind, payload


def split_names(payload: bytes) -> list[str]:
    """Return the names of a comma-separated list; empty ones (a trailing comma) are dropped."""
    text = payload.decode("ascii", "replace")
    return [name.strip() for name in text.split(",") if name.strip()]


def _types(names: list[str], table: Mapping[str, str]) -> list[str]:
    return [table.get(name, "NOT_FOUND") for name in names]


@dataclass(frozen=True, slots=True)
class OutputRecipe:
    """A configured output list: packs a whole data frame from the controller's memory."""

    types: tuple[str, ...]
    plan: tuple[tuple[str, bool], ...]
    layout: struct.Struct
    head: tuple[int, ...]
    every: int

    @property
    def complete(self) -> bool:
        """Whether every name was found."""
        return "NOT_FOUND" not in self.types

    def encode(self, memory: Mapping[str, Any]) -> bytes:
        """Return one data frame of the present values of `memory`."""
        flat: list[Any] = list(self.head)
        for name, scalar in self.plan:
            if scalar:
                flat.append(memory[name])
            else:
                flat.extend(memory[name])
        return self.layout.pack(*flat)


def output_recipe(names: list[str], version: int, every: int) -> OutputRecipe:
    """Return the encoder of `names`, sent in every `every`-th cycle, in protocol `version`."""
    types = _types(names, OUTPUTS)
    available = [(n, t) for n, t in zip(names, types, strict=True) if t != "NOT_FOUND"]
    plan = tuple((n, FORMATS[t][1] == 1) for n, t in available)
    start = ">HBB" if version == 2 else ">HB"
    layout = struct.Struct(start + "".join(FORMATS[t][0] for _, t in available))
    head = (layout.size, DATA, 1) if version == 2 else (layout.size, DATA)
    return OutputRecipe(tuple(types), plan, layout, head, every)


@dataclass(frozen=True, slots=True)
class InputRecipe:
    """A configured input list: turns the payload of a client's data frame into values."""

    plan: tuple[tuple[str, int], ...]
    layout: struct.Struct

    def decode(self, payload: bytes) -> dict[str, Any]:
        """Return name -> value of what fits: a short payload fills the first fields only.

        Clients send payloads of a wrong length (measured), so length is no reason to refuse.
        """
        if len(payload) >= self.layout.size:
            return self._named(self.layout.unpack_from(payload), self.plan)
        values: dict[str, Any] = {}
        offset = 0
        for name, count in self.plan:
            one = struct.Struct(">" + FORMATS[INPUTS[name]][0])
            if offset + one.size > len(payload):
                break
            values |= self._named(one.unpack_from(payload, offset), ((name, count),))
            offset += one.size
        return values

    @staticmethod
    def _named(flat: tuple[Any, ...], plan: tuple[tuple[str, int], ...]) -> dict[str, Any]:
        values: dict[str, Any] = {}
        index = 0
        for name, count in plan:
            values[name] = flat[index] if count == 1 else flat[index : index + count]
            index += count
        return values


def input_recipe(names: list[str]) -> InputRecipe | None:
    """Return the decoder of `names`; None if one of them is unknown."""
    if any(name not in INPUTS for name in names):
        return None
    plan = tuple((n, FORMATS[INPUTS[n]][1]) for n in names)
    layout = struct.Struct(">" + "".join(FORMATS[INPUTS[n]][0] for n in names))
    return InputRecipe(plan, layout)
