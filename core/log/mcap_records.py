"""Whole records of an MCAP file that may end anywhere, or be damaged: killed, cut, flipped bytes.

A record counts when it is there to its last byte and, being a chunk, its checksum is right. Behind
a damaged stretch reading goes on with the next chunk that counts. Format: the MCAP specification.
"""

from __future__ import annotations

import os
import re
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
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from gapbridge.core.errors import LogError

LARGEST_CHUNK = 1 << 28  # bytes, unpacked: one that says more is garbage
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
HEAD_SIZE = _HEAD.size  # bytes before a record's data: opcode and length
_KNOWN = frozenset(int(code) for code in Opcode)
_ENDS = {Opcode.DATA_END: 4, Opcode.FOOTER: 20}  # and their lengths
_CHUNK = re.compile(rb"(?=\x06.{4}\0{4})", re.DOTALL)  # its head: opcode, a length below 4 GiB
_BLOCK = 1 << 20  # bytes that are searched for it at a time
# what the libraries raise where bytes are not what they should be
BROKEN = (
    McapError, struct.error, ValueError, EOFError, RuntimeError, OverflowError, MemoryError,
    zstandard.ZstdError,
)  # fmt: skip


@dataclass
class Message:
    """One message, not yet decoded."""

    channel: int
    log_time: int  # ns since 1970
    data: bytes


@dataclass
class Contents:
    """What one chunk holds."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: list[Message]


def chunk_offsets(file: IO[bytes], path: Path) -> Iterator[tuple[int, int]]:
    """Yield where the data of each chunk record begins, and its length, up to the end.

    Raises LogError where the file is no MCAP file. A file of nothing has no chunks.
    """
    for code, offset, length in all_records(file, path):
        if code == Opcode.CHUNK:
            yield offset, length


def all_records(file: IO[bytes], path: Path) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, where its data begins, and its length, of each record of the data section.

    Where a record is not there to its last byte, the next chunk that can be read comes next; ends
    where there is none. Raises LogError where it is no MCAP file.
    """
    size = os.fstat(file.fileno()).st_size
    file.seek(0)
    magic = file.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC[: len(magic)]:
        raise LogError(f"{path}: found no MCAP file, expected a recording of the daemon")
    offset = before = len(MCAP0_MAGIC)
    while offset + HEAD_SIZE <= size:
        file.seek(offset)
        code, length = _HEAD.unpack(file.read(HEAD_SIZE))
        if _ENDS.get(code) == length:
            return
        if code not in _KNOWN or code in _ENDS or offset + HEAD_SIZE + length > size:
            # the length of the record before may be what is wrong
            before = offset = _next_chunk(file, before + 1, size)
            continue
        yield code, offset + HEAD_SIZE, length
        before, offset = offset, offset + HEAD_SIZE + length


def _next_chunk(file: IO[bytes], start: int, size: int) -> int:
    """Return where the next chunk record that can be read begins, ``size`` if there is none."""
    while start + HEAD_SIZE <= size:
        file.seek(start)
        block = file.read(_BLOCK)
        for match in _CHUNK.finditer(block):
            offset = start + match.start()
            _, length = _HEAD.unpack_from(block, match.start())
            if offset + HEAD_SIZE + length <= size and unpacked(file, offset + HEAD_SIZE, length):
                return offset
        start += max(len(block) - HEAD_SIZE + 1, 1)
    return size


def damages(path: Path) -> list[tuple[int, int]]:
    """Return first byte and length of the stretches of a file that cannot be read.

    What is behind the last readable chunk of an unfinished file is none: it was being written.
    Raises OSError, LogError where it is no MCAP file.
    """
    found: list[tuple[int, int]] = []
    behind: list[tuple[int, int]] = []  # since the last readable chunk
    end = len(MCAP0_MAGIC)
    with path.open("rb") as file:
        for code, offset, length in all_records(file, path):
            start = offset - HEAD_SIZE
            if start > end:
                behind.append((end, start - end))
            end = offset + length
            if code == Opcode.CHUNK and unpacked(file, offset, length) is None:
                behind.append((start, end - start))
            elif code == Opcode.CHUNK:
                found += behind
                behind = []
        if not is_whole(path):
            return found
        file.seek(end)
        head = file.read(HEAD_SIZE)
        if len(head) < HEAD_SIZE or _HEAD.unpack(head)[0] not in _ENDS:
            behind.append((end, os.fstat(file.fileno()).st_size - end))
    return found + behind


def is_whole(path: Path) -> bool:
    """Return whether the file was finished: its last bytes are MCAP's."""
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(size - len(MCAP0_MAGIC), 0))
        return size > 2 * len(MCAP0_MAGIC) and file.read() == MCAP0_MAGIC


def read_chunk(file: IO[bytes], offset: int, length: int) -> Contents | None:
    """Return the content of a chunk; None where it is broken."""
    chunk = unpacked(file, offset, length)
    try:
        return None if chunk is None else _contents(chunk[1])
    except BROKEN:
        return None


def definitions(file: IO[bytes]) -> Contents | None:
    """Return the schemas and channels that a finished file repeats at its end, None without."""
    try:
        summary = SeekingReader(file).get_summary()
    except (*BROKEN, OSError):
        return None
    if summary is None:
        return None
    return Contents(list(summary.schemas.values()), list(summary.channels.values()), [])


def unpacked(file: IO[bytes], offset: int, length: int) -> tuple[Chunk, bytes] | None:
    """Return a chunk record and its data unpacked, None where it is broken or holds nothing."""
    file.seek(offset)
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
    offset, end = 0, len(data)
    while offset < end:
        code, length = _HEAD.unpack_from(data, offset)
        yield code, offset + HEAD_SIZE, length
        offset += HEAD_SIZE + length


def message_head(data: bytes) -> tuple[int, int, int, int]:
    """Return channel, sequence, log time and publish time (ns) of a message's data."""
    channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data)
    return channel, sequence, log_time, publish_time


def _stream(data: bytes, offset: int, length: int) -> ReadDataStream:
    return ReadDataStream(BytesIO(data[offset : offset + length]))


def _contents(data: bytes) -> Contents:
    contents = Contents([], [], [])
    offset, end, head, message = 0, len(data), _HEAD, _MESSAGE
    add = contents.messages.append
    while offset < end:
        code, length = head.unpack_from(data, offset)
        offset += 9
        if code == Opcode.MESSAGE:
            channel, _, log_time, _ = message.unpack_from(data, offset)
            add(Message(channel, log_time, data[offset + 22 : offset + length]))
        elif code == Opcode.SCHEMA:
            contents.schemas.append(Schema.read(_stream(data, offset, length)))
        elif code == Opcode.CHANNEL:
            contents.channels.append(Channel.read(_stream(data, offset, length)))
        offset += length
    return contents
