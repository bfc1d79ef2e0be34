"""Finishing a recording that was cut off: writing the summary of its complete records.

A recorder that was killed leaves complete chunks and no summary; readers that seek cannot open such
a file. Data after the last complete record is removed; a file that is damaged before its end stays
as it is. Format: the MCAP specification.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import struct
import zlib
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    MessageIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC

from gapbridge.bridge.recording.folder import recordings
from gapbridge.core.errors import LogError
from gapbridge.core.log import mcap_records as records
from gapbridge.core.log.mcap_reading import files_of

_FOOTER = struct.Struct("<BQQQ")
FOOTER_SIZE = 20


@dataclass
class _Whole:
    """The complete records of a file."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)  # messages by channel
    end: int = 0  # bytes of the file that are kept
    last: dict[int, MessageIndex] = field(default_factory=dict)  # of the last chunk
    torn: bool = False  # the last chunk's indexes must be written again
    _chunk: ChunkIndex | None = None  # the last one, its indexes not read yet
    _indexed: dict[int, int] = field(default_factory=dict)  # channel -> offset of its index
    _index_length: int = 0

    def take(self, file: IO[bytes], code: int, offset: int, length: int) -> bool:
        """Add a record; returns False for a broken chunk, after which nothing can be read."""
        if code == Opcode.CHUNK:
            unpacked = records.unpacked(file, offset, length)
            if unpacked is None:
                return False
            self._close()
            chunk, data = unpacked
            self._chunk, self._indexed, self._index_length = _index(chunk, offset, length), {}, 0
            self._take_contents(data)
        elif code == Opcode.MESSAGE_INDEX and self._chunk is not None:
            file.seek(offset)
            self._indexed[int.from_bytes(file.read(2), "little")] = offset - records.HEAD_SIZE
            self._index_length += records.HEAD_SIZE + length
        elif code != Opcode.HEADER:
            return True
        self.end = offset + length
        return True

    def finish(self) -> None:
        """End with the last chunk; incomplete indexes are dropped."""
        self.torn = self._chunk is not None and set(self._indexed) != set(self.last)
        if self._chunk is not None and self.torn:
            self.end = self._chunk.chunk_start_offset + self._chunk.chunk_length
            self._indexed, self._index_length = {}, 0
        self._close()

    def _close(self) -> None:
        if self._chunk is not None:
            offsets, length = self._indexed, self._index_length
            self.chunks.append(
                replace(self._chunk, message_index_offsets=offsets, message_index_length=length)
            )

    def _take_contents(self, data: bytes) -> None:
        self.last = {}
        for code, start, size in records.inner_records(data):
            body = data[start : start + size]
            if code == Opcode.MESSAGE:
                channel, _, log_time, _ = records.message_head(body)
                index = self.last.setdefault(channel, MessageIndex(channel, []))
                index.records.append((log_time, start - records.HEAD_SIZE))
                self.counts[channel] = self.counts.get(channel, 0) + 1
            elif code == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(body)))
                self.schemas[schema.id] = schema
            elif code == Opcode.CHANNEL:
                reported = Channel.read(ReadDataStream(BytesIO(body)))
                self.channels[reported.id] = reported


def finish(path: Path) -> bool:
    """Write the summary of a file that has none; returns whether it lacked one and got it.

    A file that is being written is left unchanged, and one with a readable chunk behind a damaged
    stretch, which truncating would lose. Raises OSError if it cannot be written, LogError
    if it is not an MCAP file.
    """
    if records.is_whole(path):
        return False
    with path.open("r+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        if records.is_whole(path) or records.damages(path):
            return False
        whole = _scan(file, path)
        if not whole.end:
            return False
        tail = _tail(whole)
        file.truncate(whole.end)
        file.seek(whole.end)
        file.write(tail)
        file.flush()
        os.fsync(file.fileno())
    return True


def finish_recording(recording: Path) -> list[Path]:
    """Finish the files of a recording; returns those finished. Raises LogError for no recording.

    A file in a read-only folder is left unchanged: it can be read all the same.
    """
    return [path for path in files_of(recording) if _finished(path)]


def unfinished(folder: Path) -> list[Path]:
    """Return the recordings of a folder that have no summary, oldest first; never raises."""
    paths = []
    with contextlib.suppress(OSError):
        for _, _, path in recordings(folder):
            with contextlib.suppress(OSError):
                if path.is_file() and not records.is_whole(path):
                    paths.append(path)
    return paths


def _finished(path: Path) -> bool:
    with contextlib.suppress(OSError, LogError):
        return finish(path)
    return False


def _scan(file: IO[bytes], path: Path) -> _Whole:
    """Return the complete records, up to the first incomplete one."""
    whole = _Whole()
    for code, offset, length in records.all_records(file, path):
        if not whole.take(file, code, offset, length):
            break
    whole.finish()
    return whole


def _index(chunk: Chunk, offset: int, length: int) -> ChunkIndex:
    return ChunkIndex(
        chunk_length=length + records.HEAD_SIZE, chunk_start_offset=offset - records.HEAD_SIZE,
        compression=chunk.compression, compressed_size=len(chunk.data),
        message_end_time=chunk.message_end_time, message_index_length=0, message_index_offsets={},
        message_start_time=chunk.message_start_time, uncompressed_size=chunk.uncompressed_size,
    )  # fmt: skip


def _tail(whole: _Whole) -> bytes:
    """Return the bytes after the complete records: missing indexes, summary, footer, magic."""
    data = RecordBuilder()
    chunks = whole.chunks
    if whole.torn:
        offsets_of = {}
        for channel, index in whole.last.items():
            offsets_of[channel] = whole.end + data.count
            index.write(data)
        chunks = [
            *chunks[:-1],
            replace(chunks[-1], message_index_offsets=offsets_of, message_index_length=data.count),
        ]
    DataEnd(0).write(data)
    begin: bytes = data.end()  # type: ignore[no-untyped-call]
    start = whole.end + len(begin)
    summary = RecordBuilder()
    groups = (
        (Opcode.SCHEMA, list(whole.schemas.values())),
        (Opcode.CHANNEL, list(whole.channels.values())),
        (Opcode.STATISTICS, [_statistics(whole)]),
        (Opcode.CHUNK_INDEX, chunks),
    )
    offsets = []
    for code, group in groups:
        first = summary.count
        for record in group:
            record.write(summary)
        offsets.append(SummaryOffset(code, start + first, summary.count - first))
    offsets_at = start + summary.count
    for offset in offsets:
        offset.write(summary)
    text: bytes = summary.end()  # type: ignore[no-untyped-call]
    crc = zlib.crc32(_FOOTER.pack(Opcode.FOOTER, FOOTER_SIZE, start, offsets_at), zlib.crc32(text))
    footer = RecordBuilder()
    Footer(start, offsets_at, crc).write(footer)
    end: bytes = footer.end()  # type: ignore[no-untyped-call]
    return begin + text + end + MCAP0_MAGIC


def _statistics(whole: _Whole) -> Statistics:
    times = [(c.message_start_time, c.message_end_time) for c in whole.chunks]
    return Statistics(
        attachment_count=0, channel_count=len(whole.channels), channel_message_counts=whole.counts,
        chunk_count=len(whole.chunks), message_count=sum(whole.counts.values()),
        message_end_time=max((end for _, end in times), default=0),
        message_start_time=min((begin for begin, _ in times), default=0), metadata_count=0,
        schema_count=len(whole.schemas),
    )  # fmt: skip
