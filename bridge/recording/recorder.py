"""The recorder: writes cycles from the shared memory into files and survives failures of the disk.

It keeps the number of the last cycle that a complete flush has written. After a failure, or in a
new process, it goes on with the next cycle if the ring still holds it; cycles that were overwritten
are counted and reported as lost.
"""

from __future__ import annotations

import contextlib
import os
import re
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.document.output_file import make_folder
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.recording.finishing import finish, unfinished
from gapbridge.bridge.recording.folder import next_path, number_after, prune, segments
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import LogError
from gapbridge.core.log.mcap_schema import CONFIGURATION, EVENTS, LOG, STATUS
from gapbridge.drivers.clock import Clock

FLUSH_EVERY = 0.4  # s
RETRY_EVERY = 2.0  # s between attempts while the disk cannot be written to
MOST_EVENTS = 10_000  # kept while nothing can be written
MB = 1e6

Event = Mapping[str, Any]
Emit = Callable[[dict[str, Any]], None]
LEVELS = {"info": 2, "warning": 3, "error": 4}  # foxglove.Log's own numbers
_PLAIN = ("time", "monotonic", "sequence", "kind", "cycle")


class Recorder:
    """Records one run. ``step`` is called about ten times a second and never raises OSError.

    ``configuration`` is the document that every file begins with; ``emit`` takes events of the
    recorder's own (kind "recorder").
    """

    def __init__(
        self,
        settings: RecordingSettings,
        session: str,
        memory: SharedMemory,
        configuration: Mapping[str, Any],
        emit: Emit,
        clock: Clock,
    ) -> None:
        self._clock = clock
        assert settings.folder is not None
        self._settings, self._folder, self._session = settings, settings.folder, session
        self._memory, self._emit = memory, emit
        self.configuration: dict[str, Any] = dict(configuration)
        self._states = [state.name for state in State]
        self._segment: Segment | None = None
        self._events: deque[Event] = deque(maxlen=MOST_EVENTS)  # not yet flushed
        self._flushed = self._clock.monotonic()
        self._retry_at = 0.0
        self._pause_reason = ""
        self.lost = 0  # cycles since this process began that no file holds
        self._next = self._resume()  # number of the first cycle that is in no complete flush
        self._reader = memory.reader(self._next)
        self._cut_off = unfinished(self._folder)  # files of recorders that were killed

    def _resume(self) -> int:
        """Return the number of the cycle after the last one that this run's files hold."""
        number = 0
        for path in segments(self._folder, self._session):
            with contextlib.suppress(OSError, LogError):
                number = max(number, number_after(path))
        return number

    @property
    def path(self) -> Path | None:
        """Return the file that is being written."""
        return None if self._segment is None else self._segment.path

    def take(self, event: Event) -> None:
        """Queue an event; it is in the file after the next flush."""
        self._events.append(event)

    def step(self, flush: bool = False) -> int:
        """Read the new cycles; flush, rotate, pause, resume. Returns the number of cycles read."""
        now = self._clock.monotonic()
        if self._segment is None and now < self._retry_at and not flush:
            return 0
        if self._segment is None and not self._open():
            return 0
        assert self._segment is not None
        rows = self._reader.drain()
        try:
            if len(rows):
                numbers = rows[:, 0].astype(int)
                self._segment.write(rows[numbers % self._settings.every == 0])
            if flush or now - self._flushed >= FLUSH_EVERY:
                self._flush(now)
        except OSError as error:
            self._pause(error.strerror or str(error))
        self._finish_one()
        return len(rows)

    def _finish_one(self) -> None:
        """Write the summary of one file whose recorder was killed; cycles wait in the ring."""
        if self._cut_off and self._segment is not None:
            path = self._cut_off.pop(0)
            with contextlib.suppress(OSError, LogError):
                if finish(path):
                    self._report(f"finished {path}, which had been cut off", file=str(path))

    def close(self) -> None:
        """Write the remaining cycles and finish the file."""
        self.step(flush=True)
        if self._segment is None:
            self._memory.follow()  # a paused recorder has not
            self._report_lost(max(self._memory.written - self._next, 0))
        else:
            try:
                self._segment.close()
            except OSError as error:
                self._pause(error.strerror or str(error))
        self._segment = None

    # -- inside -----------------------------------------------------------------------------------

    def _flush(self, now: float) -> None:
        """Write events and cycles so far into the file, then check the free space."""
        segment = self._segment
        assert segment is not None
        for event in self._events:
            self._write_event(segment, event)
        segment.flush()
        self._events.clear()
        self._report_lost(self._reader.take_lost())
        self._next, self._flushed = self._reader.next, now
        room = self._free_space()
        if room < self._settings.keep_free:
            segment.close()
            self._pause(f"{room:.0f} MB free, recording.keep_free is {self._settings.keep_free:g}")
        elif (
            segment.size > self._settings.segment_size * MB
            or now - segment.opened > self._settings.segment_time
        ):
            segment.close()
            self._segment = None
            self._open()

    def _write_event(self, segment: Segment, event: Event) -> None:
        time = event.get("time")
        time = time if isinstance(time, int | float) else self._clock.time()
        if event.get("kind") == EventKind.STATUS:
            segment.emit(STATUS, event, time)
            return
        segment.emit(EVENTS, event, time)
        second, nanosecond = divmod(int(time * 1e9), 10**9)
        log = {
            "timestamp": {"sec": second, "nsec": nanosecond}, "level": LEVELS[level_of(event)],
            "message": text_of(event), "name": "gapbridge", "file": "", "line": 0,
        }  # fmt: skip
        segment.emit(LOG, log, time)

    def _open(self) -> bool:
        """Begin a new file; returns False where the disk does not allow one."""
        try:
            make_folder(self._folder)
            prune(self._folder, self._session, self._settings.keep_total)
            if self._free_space() < self._settings.keep_free:
                raise OSError(0, f"less than {self._settings.keep_free:g} MB free")
            path = next_path(self._folder, self._session)
            self._segment = Segment(path, self._memory.slices, self._states, self._clock)
            self._describe()
            self._segment.flush()
        except OSError as error:
            self._discard()
            self._pause(error.strerror or str(error))
            return False
        self._pause_reason = ""
        self._reader = self._memory.reader(self._next)
        self._flushed = self._clock.monotonic()
        self._report(f"recording into {path}", file=str(path))
        return True

    def _discard(self) -> None:
        """Remove a file whose head could not be written: each retry would leave another one."""
        if self._segment is not None:
            self._segment.abandon()
            with contextlib.suppress(OSError):
                self._segment.path.unlink()
        self._segment = None

    def _describe(self) -> None:
        assert self._segment is not None
        number = int(re.sub(r".*-", "", self._segment.path.stem))
        document = {
            "time": self._clock.time(), "session": self._session, "segment": number,
            "clock": self._segment.clock / 1e9, "every": self._settings.every,
            "first_cycle": self._next, **self.configuration,
        }  # fmt: skip
        self._segment.emit(CONFIGURATION, document)

    def change_configuration(self, configuration: Mapping[str, Any]) -> None:
        """Write the configuration that the daemon uses from now on into the file."""
        self.configuration = dict(configuration)
        if self._segment is not None:
            self._describe()

    def _pause(self, reason: str) -> None:
        """Abandon the file, keep what complete flushes have written, and retry later."""
        if self._segment is not None:
            self._segment.abandon()
            self._cut_off.append(self._segment.path)
        self._segment = None
        self._retry_at = self._clock.monotonic() + RETRY_EVERY
        if reason != self._pause_reason:
            self._report(f"recording paused: {reason}", paused=reason, next_cycle=self._next)
        self._pause_reason = reason

    def _report_lost(self, lost: int) -> None:
        if lost:
            self.lost += lost
            self._report(f"{lost} cycles lost before cycle {self._memory.written}", lost=lost)

    def _report(self, message: str, **fields: Any) -> None:
        event = {
            "time": self._clock.time(), "monotonic": self._clock.monotonic(),
            "kind": EventKind.RECORDER, "detail": message, **fields,
        }  # fmt: skip
        self._emit(event)

    def _free_space(self) -> float:
        """Return the free space of the folder's file system, MB."""
        stats = os.statvfs(self._folder)
        return stats.f_bavail * stats.f_frsize / MB


def level_of(event: Mapping[str, Any]) -> str:
    """Return the level of an event: a key of LEVELS."""
    if event.get("kind") == EventKind.FAULT or event.get("to") == State.FAULT.name:
        return "error"
    warns = event.get("kind") == EventKind.REFUSED or "paused" in event or "lost" in event
    return "warning" if warns or event.get("to") == State.HOLDING.name else "info"


def text_of(event: Mapping[str, Any]) -> str:
    """Return an event as one line of text."""
    if "from" in event and "to" in event:
        text = f"{event['from']} -> {event['to']} ({event.get('cause', '')})"
        return f"{text}: {event['detail']}" if event.get("detail") else text
    if event.get("detail"):
        return str(event["detail"])
    parts = [f"{key} {value}" for key, value in event.items() if key not in _PLAIN]
    return f"{event.get('kind', '')}: {', '.join(parts)}"
