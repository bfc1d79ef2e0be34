"""From a recording to a log: the log's columns, and the daemon's results as further columns."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np

from gapbridge.bridge.document.output_file import replacing_bytes
from gapbridge.bridge.recording.finishing import finish_recording
from gapbridge.core.errors import InputError, LogError
from gapbridge.core.log.columns import COLUMNS, PARQUET, scalars
from gapbridge.core.log.mcap_reading import Batch, read_batches
from gapbridge.core.log.mcap_schema import ENUM_FIELD

if TYPE_CHECKING:
    import pyarrow

ADDED = ("nominal_q", "corrected_q", "offset", "written", "age", "residual", "clamped", "number")
LONGEST = 1e9  # s that a bound of a span may be from an end
GROUP = 20_000  # rows of a Parquet row group at least


@dataclass
class Exported:
    """The result of an export."""

    rows: int = 0
    gaps: int = 0  # cycles missing between the first and the last
    back: int | None = None  # row (from 0) at which the controller's clock goes back
    first: float | None = None  # s since 1970
    last: float | None = None
    states: dict[str, int] = field(default_factory=dict)  # rows by state
    _number: float | None = None
    _timestamp: float = -np.inf

    def take(self, batch: Batch, every: int) -> None:
        """Add a batch to the counts."""
        numbers, times = batch.columns["number"], batch.columns["timestamp"]
        before = numbers[0] - every if self._number is None else self._number
        steps = np.diff(numbers, prepend=before)
        self.gaps += int(np.sum(np.maximum(steps - every, 0)) // every)
        wrong = np.flatnonzero(np.diff(times, prepend=self._timestamp) <= 0)
        if len(wrong) and self.back is None:
            self.back = self.rows + int(wrong[0])
        if self.first is None:
            self.first = batch.log_time[0] / 1e9
        self.last = batch.log_time[-1] / 1e9
        self._number, self._timestamp = numbers[-1], times[-1]
        self.rows += len(batch)
        for value, count in zip(*np.unique(batch.columns[ENUM_FIELD], return_counts=True),
                                strict=True):  # fmt: skip
            name = _state(batch, value)
            self.states[name] = self.states.get(name, 0) + int(count)


@dataclass(frozen=True)
class Span:
    """A time span of a recording: bounds as ``moment`` reads them, None = open."""

    start: float | datetime | None = None
    stop: float | datetime | None = None


def moment(text: str) -> float | datetime:
    """Return a bound of a span: s from the beginning (negative: from the end), or a time.

    Raises InputError if it is neither.
    """
    with contextlib.suppress(ValueError):
        if "_" not in text and abs(seconds := float(text)) < LONGEST:  # Python reads 1_0 as 10
            return seconds
    try:
        return datetime.fromisoformat(text).astimezone()
    except (ValueError, OverflowError):  # 9999-12-31 is beyond the last day in the west
        raise InputError(
            f"found {text!r}, expected seconds from the beginning (negative: before the end) or a "
            "time like 2026-01-31T14:05:00"
        ) from None


def export(recording: Path, out: Path, span: Span | None = None) -> Exported:
    """Write a recording's cycles as a log: CSV, or Parquet where the suffix of ``out`` says so.

    Columns without values are left out. A recording that was cut off is finished, if its folder can
    be written to. Raises LogError if the recording cannot be used or has no cycle in the span.
    """
    finish_recording(recording)
    first, last = _bounds(recording, span or Span())
    columns = _columns_of(recording, first, last)
    exported, every = Exported(), _every(recording)

    def tables() -> Iterator[pyarrow.Table]:
        for batch in _within(recording, first, last):
            exported.take(batch, every)
            yield _table(batch, columns)

    write = _write_parquet if out.suffix.lower() in PARQUET else _write_csv
    with replacing_bytes(out) as file:
        write(file, tables())
    return exported


def _every(recording: Path) -> int:
    for batch in read_batches(recording):
        for channel, document in batch.documents:
            if channel == "/configuration":
                return max(int(document.get("every", 1)), 1)
    return 1


def _within(recording: Path, first: int, last: int) -> Iterator[Batch]:
    """Yield the batches that hold cycles between two times, ns since 1970, cut to them."""
    for batch in read_batches(recording):
        wanted = (batch.log_time >= first) & (batch.log_time <= last)
        if wanted.all() and len(wanted):
            yield batch
        elif wanted.any():
            yield Batch(
                {name: values[wanted] for name, values in batch.columns.items()},
                batch.log_time[wanted], (), batch.state_names,
            )  # fmt: skip


def _bounds(recording: Path, span: Span) -> tuple[int, int]:
    """Return a span as ns since 1970."""
    begin, end = None, 0
    if isinstance(span.start, float) or isinstance(span.stop, float):
        for batch in read_batches(recording):
            if len(batch):
                begin = int(batch.log_time[0]) if begin is None else begin
                end = int(batch.log_time[-1])

    def nanoseconds(bound: float | datetime | None, otherwise: int) -> int:
        if bound is None:
            return otherwise
        if isinstance(bound, datetime):
            return int(bound.timestamp() * 1e9)
        return int(bound * 1e9) + (end if bound < 0 else begin or 0)

    return nanoseconds(span.start, 0), nanoseconds(span.stop, 2**63 - 1)


def _columns_of(recording: Path, first: int, last: int) -> list[str]:
    """Return the columns with values, in the log's order."""
    carried: set[str] = set()
    empty = True
    for batch in _within(recording, first, last):
        empty = False
        missing = [name for name in batch.columns if name not in carried]
        carried.update(name for name in missing if not np.isnan(batch.columns[name]).all())
    if empty:
        raise LogError(f"{recording}: found no cycles there, expected at least one to export")
    return [name for name in (*COLUMNS, *ADDED) if name in carried]


def _table(batch: Batch, columns: list[str]) -> pyarrow.Table:
    import pyarrow

    arrays: dict[str, Any] = {
        name: np.ascontiguousarray(values)
        for name, values in scalars({name: batch.columns[name] for name in columns}).items()
    }
    arrays[ENUM_FIELD] = [_state(batch, value) for value in batch.columns[ENUM_FIELD]]
    return pyarrow.table(arrays)


def _state(batch: Batch, value: float) -> str:
    known: Mapping[int, str] = dict(enumerate(batch.state_names))
    return known.get(int(value), str(int(value))).lower()


def _write_csv(file: IO[bytes], tables: Iterator[pyarrow.Table]) -> None:
    """Write tables as rows of CSV; numbers read back exactly."""
    from pyarrow import csv

    options = csv.WriteOptions(include_header=False, quoting_style="none")
    for number, table in enumerate(tables):
        if number == 0:
            file.write((",".join(table.column_names) + "\n").encode())
        csv.write_csv(table, file, options)


def _write_parquet(file: IO[bytes], tables: Iterator[pyarrow.Table]) -> None:
    """Write tables, at least one, as row groups of a Parquet file."""
    import pyarrow
    from pyarrow import parquet

    waiting = [next(tables)]
    with parquet.ParquetWriter(file, waiting[0].schema, compression="zstd") as writer:
        for table in tables:
            if sum(map(len, waiting)) >= GROUP:
                writer.write_table(pyarrow.concat_tables(waiting))
                waiting.clear()
            waiting.append(table)
        writer.write_table(pyarrow.concat_tables(waiting))
