"""The recorder: from the shared memory into files, whatever happens to the disk or to itself.

What counts is the number of the last cycle that a whole flush has written. After a failure, or in a
new process, reading goes on behind it as long as the ring still holds what comes next; what it no
longer holds is counted and reported.
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
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.loop.supervisor import State
from gapbridge.bridge.recording.finishing import finish, unfinished
from gapbridge.bridge.recording.folder import next_path, number_after, prune, segments
from gapbridge.bridge.recording.segment import Segment
from gapbridge.core.errors import LogError
from gapbridge.core.log.mcap_schema import CONFIGURATION, EVENTS, LOG, STATUS
from gapbridge.drivers.clock import SYSTEM, Clock

FLUSH_EVERY = 0.4  # s
RETRY_EVERY = 2.0  # s after which a disk that refused is tried again
MOST_EVENTS = 10_000  # kept while nothing can be written
MB = 1e6

Event = Mapping[str, Any]
Emit = Callable[[dict[str, Any]], None]
LEVELS = {"info": 2, "warning": 3, "error": 4}  # foxglove.Log's own numbers
_PLAIN = ("time", "monotonic", "sequence", "kind", "cycle")


class Recorder:
    """Records one run. ``step`` is called some ten times a second; it never raises for the disk.

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
        clock: Clock = SYSTEM,
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
        self._why_paused = ""
        self.lost = 0  # cycles of this process's time that no file holds
        self._next = self._resume()  # number of the first cycle that no whole flush holds
        self._reader = memory.reader(self._next)
        self._cut_off = unfinished(self._folder)  # files of recorders that were killed

    def _resume(self) -> int:
        """Return where a former process of this run has stopped."""
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
        """Take an event over; it is in the file after the next flush."""
        self._events.append(event)

    def step(self, flush: bool = False) -> int:
        """Take the new cycles; flush, rotate, pause, resume. Returns the cycles taken."""
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
        """Write the summary of one file that a kill has cut off; the ring waits meanwhile."""
        if self._cut_off and self._segment is not None:
            path = self._cut_off.pop(0)
            with contextlib.suppress(OSError, LogError):
                if finish(path):
                    self._report(f"finished {path}, which had been cut off", file=str(path))

    def close(self) -> None:
        """Write what is there and finish the file."""
        self.step(flush=True)
        if self._segment is None:
            self._report_lost(max(self._memory.written - self._next, 0))
        else:
            try:
                self._segment.close()
            except OSError as error:
                self._pause(error.strerror or str(error))
        self._segment = None

    # -- inside -----------------------------------------------------------------------------------

    def _flush(self, now: float) -> None:
        """Write events and cycles so far into the file, then see how much room there is."""
        segment = self._segment
        assert segment is not None
        for event in self._events:
            self._write_event(segment, event)
        segment.flush()
        self._events.clear()
        self._report_lost(self._reader.take_lost())
        self._next, self._flushed = self._reader.next, now
        room = self._room()
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
        if event.get("kind") == "status":
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
        """Begin a new file; returns whether there is one."""
        try:
            make_folder(self._folder)
            prune(self._folder, self._session, self._settings.keep_total)
            if self._room() < self._settings.keep_free:
                raise OSError(0, f"less than {self._settings.keep_free:g} MB free")
            path = next_path(self._folder, self._session)
            self._segment = Segment(path, self._memory.slices, self._states, self._clock)
            self._describe()
            self._segment.flush()
        except OSError as error:
            self._pause(error.strerror or str(error))
            return False
        self._why_paused = ""
        self._reader = self._memory.reader(self._next)
        self._flushed = self._clock.monotonic()
        self._report(f"recording into {path}", file=str(path))
        return True

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
        """Note that the daemon runs by another configuration from now on."""
        self.configuration = dict(configuration)
        if self._segment is not None:
            self._describe()

    def _pause(self, why: str) -> None:
        """Give the file up, keep what whole flushes have written, and try again later."""
        if self._segment is not None:
            self._segment.abandon()
            self._cut_off.append(self._segment.path)
        self._segment = None
        self._retry_at = self._clock.monotonic() + RETRY_EVERY
        if why != self._why_paused:
            self._report(f"recording paused: {why}", paused=why, next_cycle=self._next)
        self._why_paused = why

    def _report_lost(self, lost: int) -> None:
        if lost:
            self.lost += lost
            self._report(f"{lost} cycles lost before cycle {self._memory.written}", lost=lost)

    def _report(self, message: str, **fields: Any) -> None:
        event = {
            "time": self._clock.time(), "monotonic": self._clock.monotonic(), "kind": "recorder",
            "detail": message, **fields,
        }  # fmt: skip
        self._emit(event)

    def _room(self) -> float:
        """Return the MB that are free for us."""
        stats = os.statvfs(self._folder)
        return stats.f_bavail * stats.f_frsize / MB


def level_of(event: Mapping[str, Any]) -> str:
    """Return how grave an event is."""
    if event.get("kind") == "fault" or event.get("to") == "FAULT":
        return "error"
    grave = event.get("kind") == "refused" or "paused" in event or "lost" in event
    return "warning" if grave or event.get("to") == "HOLDING" else "info"


def text_of(event: Mapping[str, Any]) -> str:
    """Return an event in words."""
    if "from" in event and "to" in event:
        text = f"{event['from']} -> {event['to']} ({event.get('cause', '')})"
        return f"{text}: {event['detail']}" if event.get("detail") else text
    if event.get("detail"):
        return str(event["detail"])
    parts = [f"{key} {value}" for key, value in event.items() if key not in _PLAIN]
    return f"{event.get('kind', '')}: {', '.join(parts)}"
