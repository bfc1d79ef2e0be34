"""The recorder's process, and what must be in its files."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.simulation.disk import Disk
from benchmarks.simulation.world import Process, SimulatedClock
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.recording.folder import segments
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.core.log.mcap_reading import read_batches

LOOK = 0.1  # s, of bridge/recording/main.py
RESTART = 0.2  # s, of the daemon's side processes
RECENT = 1.0  # s of cycles that a recorder may take with it for good: 0.4 s until synced, twice


class Recording:
    """The recorders of one daemon, one after the other."""

    def __init__(
        self, disk: Disk, clock: SimulatedClock, memory: SharedMemory, session: str
    ) -> None:
        self._disk, self._clock, self._memory, self._session = disk, clock, memory, session
        self._settings = RecordingSettings(folder=disk.folder, keep_free=0.0)
        self.is_over: Callable[[], bool] = lambda: False  # the daemon is, and its loop
        self.is_alone: Callable[[], bool] = lambda: False  # no daemon can start it anew
        self.lost = 0  # cycles that were reported as lost
        self.cut_at = math.inf  # s: when it died and no other one followed
        self._paused_from = math.inf  # cycle from which on none was written, as was reported
        self._resumed_at = -math.inf  # s
        self._recorder: Recorder | None = None
        self._start()

    def _start(self) -> None:
        count = len(self._clock.world.processes)
        self.process = Process(self._clock.world, f"recorder {count}", self._record)

    def _record(self) -> None:
        self._recorder = recorder = Recorder(
            self._settings, self._session, self._memory, {}, self._take, self._clock
        )
        while not self.is_over():
            self._clock.sleep(LOOK)
            recorder.step()
        recorder.close()

    def _take(self, event: dict[str, Any]) -> None:
        self.lost += int(event.get("lost", 0))
        if "paused" in event:
            self._paused_from, self._resumed_at = int(event["next_cycle"]), math.inf
        elif str(event["detail"]).startswith("recording into"):
            self._resumed_at = self._clock.monotonic()

    @property
    def is_closed(self) -> bool:
        """Return whether all is written."""
        return self.process.over or self.cut_at < math.inf

    def die(self) -> None:
        """End the present process at once; the daemon, if there is one, starts another one."""
        if self.is_alone():
            self.end()
        else:
            self._kill()
            self._clock.world.after(RESTART, self._start)

    def end(self) -> None:
        """End it for good, at once; may be repeated."""
        if not self.is_closed:
            self._kill()
            self.cut_at = self._clock.world.now

    def _kill(self) -> None:
        """End the process; the system closes its file."""
        self.process.kill()
        self.let_go()

    def let_go(self) -> None:
        """Close what the process held open."""
        if self._recorder is not None and self._recorder._segment is not None:
            self._recorder._segment._file.close()

    def missing(self) -> int:
        """Return how many cycles that must be in the files are not, and were not reported."""
        rows, _ = self._memory.rows(0, self._memory.written)
        received = rows[:, self._memory.slices["received"].start]
        wanted = set(rows[received < self.cut_at - RECENT, 0].astype(int).tolist())
        if self._resumed_at > self.cut_at - RECENT:  # what waited for the disk is gone
            wanted = {number for number in wanted if number < self._paused_from}
        for path in segments(self._disk.folder, self._session):
            for batch in read_batches(path):
                if "number" in batch.columns:
                    wanted -= set(np.asarray(batch.columns["number"]).astype(int).tolist())
        return max(len(wanted) - self.lost, 0)
