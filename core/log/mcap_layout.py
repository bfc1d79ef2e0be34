"""Cycles as protobuf messages of one length: many at once, through arrays of bytes.

A message whose fields all have fixed sizes is the same bytes from cycle to cycle but for its
numbers. So a batch is a matrix of bytes into which columns are written, or read from, at once; any
protobuf reader reads the same messages. Wire format: protobuf's encoding guide.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.log.mcap_schema import ENUM_FIELD, LOOP, Sizes

Bytes = NDArray[np.uint8]
_VARINT, _FIXED64, _LENGTH = 0, 1, 2  # wire types


@dataclass(frozen=True)
class Place:
    """The position of a field's numbers in every message."""

    name: str
    start: int  # byte
    count: int  # numbers
    is_enum: bool = False  # one byte, else 8 for each number
    is_single: bool = True  # no repeated field


@dataclass(frozen=True)
class Layout:
    """The one form of a channel's messages."""

    template: bytes  # a message of zeros
    places: tuple[Place, ...]

    def encode(self, rows: Array, slices: Mapping[str, slice]) -> list[bytes]:
        """Return a message for each of the rows (k, width); ``slices``: where fields stand."""
        encoded = np.tile(np.frombuffer(self.template, np.uint8), (len(rows), 1))
        for place in self.places:
            part = rows[:, slices[place.name]]
            if place.is_enum:
                encoded[:, place.start] = part[:, 0].astype(np.uint8)
            else:
                stored = np.ascontiguousarray(part, "<f8").view(np.uint8)
                encoded[:, place.start : place.start + 8 * place.count] = stored
        data, width = encoded.tobytes(), len(self.template)
        return [data[start : start + width] for start in range(0, len(data), width)]

    def decode(self, messages: Bytes) -> dict[str, Array]:
        """Return the fields of messages (k, length): (k,) or (k, count) each, in their own memory.

        Never the messages' own: theirs is read-only and at odd addresses, for which the loop's
        compiled functions would be compiled anew, amidst a cycle.
        """
        columns: dict[str, Array] = {}
        for place in self.places:
            if place.is_enum:
                columns[place.name] = messages[:, place.start].astype(np.float64)
                continue
            stored = messages[:, place.start : place.start + 8 * place.count]
            values = stored.copy().view("<f8").astype(np.float64, copy=False)
            columns[place.name] = values[:, 0] if place.is_single else values
        return columns


def layout_of(channel: str, names: Sequence[str], sizes: Sizes) -> Layout:
    """Return how messages of a channel are written; see ``schema.descriptor_set``."""
    template, places = b"", []
    for number, name in enumerate(names, start=1):
        count = sizes[name]
        is_enum = channel == LOOP and name == ENUM_FIELD
        if is_enum:
            head, size = _varint(number << 3 | _VARINT), 1
        elif count == 1:
            head, size = _varint(number << 3 | _FIXED64), 8
        else:
            head = _varint(number << 3 | _LENGTH) + _varint(8 * count)
            size = 8 * count
        places.append(Place(name, len(template) + len(head), count, is_enum, count == 1))
        template += head + bytes(size)
    return Layout(template, tuple(places))


def layout_in(message: DescriptorProto, sample: bytes) -> Layout:
    """Return the layout that one message of a channel shows, for all of the same length.

    Raises ValueError where it is not of the kind that recordings are made of.
    """
    fields = {field.number: field for field in message.field}
    offset, places = 0, []
    while offset < len(sample):
        tag, offset = _read_varint(sample, offset)
        number, wire = tag >> 3, tag & 7
        if number not in fields:
            raise ValueError(f"found field {number}, which the schema does not have")
        field = fields[number]
        repeated = field.label == FieldDescriptorProto.LABEL_REPEATED
        if wire == _VARINT:
            start = offset
            _, offset = _read_varint(sample, offset)
            if offset - start == 1:
                places.append(Place(field.name, start, 1, is_enum=True))
            continue
        size = 8
        if wire == _LENGTH:
            size, offset = _read_varint(sample, offset)
        elif wire != _FIXED64:
            raise ValueError(f"found {field.name} with wire type {wire}, expected doubles")
        if size % 8 or offset + size > len(sample):
            raise ValueError(f"found {field.name} of {size} bytes, expected doubles")
        places.append(Place(field.name, offset, size // 8, is_single=not repeated))
        offset += size
    return Layout(sample, tuple(places))


def _varint(value: int) -> bytes:
    encoded = bytearray()
    while value > 0x7F:
        encoded.append(value & 0x7F | 0x80)
        value >>= 7
    encoded.append(value)
    return bytes(encoded)


def _read_varint(data: bytes, offset: int) -> tuple[int, int]:
    """Return a number and where it ends. Raises ValueError where it does not."""
    value = 0
    for shift in range(0, 64, 7):
        if offset >= len(data):
            break
        byte = data[offset]
        value |= (byte & 0x7F) << shift
        offset += 1
        if byte < 0x80:
            return value, offset
    raise ValueError("found a number without an end")
