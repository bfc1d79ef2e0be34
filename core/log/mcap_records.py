"""Whole records of an MCAP file that may end anywhere: killed, cut, or with garbage behind it.

A record counts when it is there to its last byte and, being a chunk, its checksum is right; what
comes after the first that does not is not read. Format: the MCAP specification.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import IO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from gapbridge.core.errors import LogError

LARGEST_CHUNK = 1 << 28  # bytes, unpacked: one that says more is garbage
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
HEAD_SIZE = _HEAD.size  # bytes before a record's data: opcode and length
_KNOWN = frozenset(int(code) for code in Opcode)
_ENDS = (Opcode.DATA_END, Opcode.FOOTER)
# what the libraries raise where bytes are not what they should be
BROKEN = (
    McapError, struct.error, ValueError, EOFError, RuntimeError, OverflowError, MemoryError,
    zstandard.ZstdError,
)  # fmt: skip


@dataclass
class Message:
    """One message, not yet decoded."""

    channel: int
    sequence: int
    log_time: int  # ns since 1970
    data: bytes


@dataclass
class Contents:
    """What one chunk holds."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: list[Message]


def chunk_offsets(file: IO[bytes], path: Path) -> Iterator[tuple[int, int]]:
    """Yield where the data of each chunk record begins, and its length, up to the end or a break.

    Raises LogError where the file is no MCAP file. A file of nothing has no chunks.
    """
    for code, at, length in all_records(file, path):
        if code == Opcode.CHUNK:
            yield at, length


def all_records(file: IO[bytes], path: Path) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, where its data begins, and its length, of each record of the data section.

    Ends where a record is not there to its last byte. Raises LogError where it is no MCAP file.
    """
    size = os.fstat(file.fileno()).st_size
    magic = file.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC[: len(magic)]:
        raise LogError(f"{path}: found no MCAP file, expected a recording of the daemon")
    at = len(MCAP0_MAGIC)
    while at + _HEAD.size <= size:
        file.seek(at)
        code, length = _HEAD.unpack(file.read(_HEAD.size))
        at += _HEAD.size
        if code not in _KNOWN or code in _ENDS or at + length > size:
            return
        yield code, at, length
        at += length


def is_whole(path: Path) -> bool:
    """Return whether the file was finished: its last bytes are MCAP's."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - len(MCAP0_MAGIC), 0))
        return size > 2 * len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC


def read_chunk(file: IO[bytes], at: int, length: int) -> Contents | None:
    """Return the content of a chunk; None where it is broken."""
    found = unpacked(file, at, length)
    try:
        return None if found is None else _contents(found[1])
    except BROKEN:
        return None


def unpacked(file: IO[bytes], at: int, length: int) -> tuple[Chunk, bytes] | None:
    """Return a chunk record and its data unpacked, None where it is broken or holds nothing."""
    file.seek(at)
    content = file.read(length)
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        if chunk.uncompressed_size > LARGEST_CHUNK or not chunk.uncompressed_crc:
            return None
        stream, size = get_chunk_data_stream(chunk, validate_crc=True)
        return (chunk, stream.read(size)) if size else None
    except BROKEN:
        return None


def inner_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, where its data begins, and its length, of each record of an unpacked chunk."""
    at, end = 0, len(data)
    while at < end:
        code, length = _HEAD.unpack_from(data, at)
        yield code, at + HEAD_SIZE, length
        at += HEAD_SIZE + length


def message_head(data: bytes) -> tuple[int, int, int, int]:
    """Return channel, sequence, log time and publish time (ns) of a message's data."""
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data)
    return channel, sequence, log_time, publish_time


def _contents(data: bytes) -> Contents:
    found = Contents([], [], [])
    at, end, head, message = 0, len(data), _HEAD, _MESSAGE
    add = found.messages.append
    while at < end:
        code, length = head.unpack_from(data, at)
        at += 9
        if code == Opcode.MESSAGE:
            channel, sequence, log_time, _ = message.unpack_from(data, at)
            add(Message(channel, sequence, log_time, data[at + 22 : at + length]))
        elif code == Opcode.SCHEMA:
            found.schemas.append(Schema.read(ReadDataStream(BytesIO(data[at : at + length]))))
        elif code == Opcode.CHANNEL:
            found.channels.append(Channel.read(ReadDataStream(BytesIO(data[at : at + length]))))
        at += length
    return found
