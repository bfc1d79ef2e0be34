"""One file of a recording: complete chunks of MCAP, written at each flush.

The library builds records; they are written to the file in one write per flush, so that the file is
valid up to its last flush however the process ends.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from gapbridge.bridge.document.json_text import json_text
from gapbridge.bridge.document.output_file import MODE, sync_folder
from gapbridge.core.arrays import Array
from gapbridge.core.log.mcap_layout import layout_of
from gapbridge.core.log.mcap_schema import (
    CYCLE_CHANNELS,
    JSON_CHANNELS,
    PACKAGE,
    descriptor_set,
    fields_by_channel,
    json_name,
    json_schema,
)
from gapbridge.drivers.clock import Clock

LARGEST_CHUNK = 1 << 26  # bytes: chunks end by flush, long before this
SYNC_SHARE = 0.1  # largest share of the time spent waiting for the disk
SYNC_EVERY = 0.4  # s between two such waits at least


class _File:
    """The library's output: buffered until ``flush``, then written at once."""

    def __init__(self, path: Path) -> None:
        self.fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, MODE)
        with contextlib.suppress(OSError):  # so that ``finish`` leaves this file unchanged
            fcntl.flock(self.fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        sync_folder(path.parent)  # else a power cut may take the name
        self.good = 0  # bytes written by complete flushes
        self._waiting = bytearray()

    def write(self, data: bytes) -> int:
        self._waiting += data
        return len(data)

    def tell(self) -> int:
        return self.good + len(self._waiting)

    def flush(self) -> None:
        """Write the buffer. Raises OSError; then the file must be abandoned."""
        view = memoryview(self._waiting)
        done = 0
        while done < len(view):
            done += os.write(self.fd, view[done:])
        view.release()
        self.good += done
        self._waiting = bytearray()

    def close(self) -> None:
        fd, self.fd = self.fd, -1
        if fd >= 0:
            os.close(fd)


class Segment:
    """One file of a run, from its first byte to its summary."""

    def __init__(
        self, path: Path, slices: Mapping[str, slice], states: Sequence[str], clock: Clock
    ) -> None:
        """Open a new file. Raises OSError, FileExistsError where the name is taken."""
        self.path, self._clock = path, clock
        self.opened = clock.monotonic()
        self.rows = 0  # added, flushed or not
        self._slices = slices
        self._next_sync = 0.0
        # ns between this machine's monotonic clock and the calendar, the same for the whole file
        self.clock = round(1e9 * (clock.time() - clock.monotonic()))
        self._file = _File(path)
        try:
            self._writer = Writer(
                self._file,  # type: ignore[arg-type]
                chunk_size=LARGEST_CHUNK,
                compression=CompressionType.ZSTD,
            )
            self._writer.start(profile="", library="gapbridge")
            self._register(states)
        except BaseException:
            self._file.close()
            raise

    def _register(self, states: Sequence[str]) -> None:
        writer = self._writer
        sizes = {name: part.stop - part.start for name, part in self._slices.items()}
        self._channels, self._layouts = {}, []
        fields = fields_by_channel(list(sizes))
        for topic in CYCLE_CHANNELS:
            schema = writer.register_schema(
                f"{PACKAGE}.{topic[1:].capitalize()}",
                "protobuf",
                descriptor_set(topic, fields[topic], sizes, states),
            )
            channel = writer.register_channel(topic, "protobuf", schema)
            self._layouts.append((channel, layout_of(topic, fields[topic], sizes)))
        for topic in JSON_CHANNELS:
            schema = writer.register_schema(json_name(topic), "jsonschema", json_schema(topic))
            self._channels[topic] = writer.register_channel(topic, "json", schema)

    @property
    def size(self) -> int:
        """Return the bytes written to the file."""
        return self._file.good

    def write(self, rows: Array) -> None:
        """Add cycles (k, width); they are in the file after the next flush."""
        if not len(rows):
            return
        numbers = rows[:, self._slices["number"].start].astype(np.int64) & 0xFFFFFFFF
        received = rows[:, self._slices["received"].start]
        known = np.where(np.isfinite(received), received, self._clock.monotonic())
        times = ((known * 1e9).astype(np.int64) + self.clock).tolist()
        add = self._writer.add_message
        encoded = [
            (channel, layout.encode(rows, self._slices)) for channel, layout in self._layouts
        ]
        for k, (number, time) in enumerate(zip(numbers.tolist(), times, strict=True)):
            for channel, messages in encoded:
                add(channel, time, messages[k], time, number)
        self.rows += len(rows)

    def emit(self, topic: str, document: Mapping[str, Any], time: float | None = None) -> None:
        """Add a JSON message; ``time``: s since 1970, else now."""
        stamp = int((self._clock.time() if time is None else time) * 1e9)
        data = json_text(document).encode()
        self._writer.add_message(self._channels[topic], stamp, data, stamp)

    def flush(self) -> None:
        """Write what was added; every SYNC_EVERY s or more wait for the disk. Raises OSError."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        now = self._clock.monotonic()
        if now >= self._next_sync:
            os.fdatasync(self._file.fd)
            spent = self._clock.monotonic() - now
            self._next_sync = now + max(SYNC_EVERY, spent / SYNC_SHARE)

    def close(self) -> None:
        """Write the summary and close. Raises OSError."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            os.fsync(self._file.fd)
        except OSError:
            self.abandon()
            raise
        self._file.close()

    def abandon(self) -> None:
        """Close, keeping what complete flushes have written; never raises."""
        if self._file.fd >= 0:
            with contextlib.suppress(OSError):
                os.ftruncate(self._file.fd, self._file.good)
            with contextlib.suppress(OSError):  # nobody syncs this file later
                os.fdatasync(self._file.fd)
            with contextlib.suppress(OSError):
                self._file.close()
