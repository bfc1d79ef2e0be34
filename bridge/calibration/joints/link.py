"""The arm through the daemon: it is watched all the time, and moved only by ``drive``.

Every run of the daemon that writes follows one trajectory, from where the arm stands to the next
pose, through the one limiter, without corrections; once it rests there the daemon only observes.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import ReadingError
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.daemon.daemon import Daemon, settings_of
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import CycleReader, Phase
from gapbridge.bridge.setpoint_source.quintic import quintic, quintic_time, write_trajectory
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import GapbridgeError, LinkError, RunError

STILL = 0.003  # rad/s: slower than this, the arm stands
NEAR = 0.05  # rad: an arm that rests this near to the pose has arrived
MOVED = 2e-4  # rad: farther than this from where it stood, it has moved
STEADY = 1.0  # N: the force may drift by this over the time of settling, beside its noise
PATIENCE = 30.0  # s for a connection, on top of the link's own
STARTING = 180.0  # s that the loop's process may take to start
SLOWEST = 4.0  # a move may take this many times as long as planned
PERIOD = 0.01  # s; between rows the daemon's source goes straight
ACCELERATION = 1.0  # rad/s2, fastest joint
SHORTEST = 0.5  # s
HOLD = 0.2  # s at the end
KEPT = 20.0  # s of cycles that are kept
STEP = 1e-5  # rad: a joint that has come this far has moved, in that direction
FOREVER = 1e9  # s


def uncorrected(path: Path) -> Cell:
    """Return a cell whose model has no effects: poses of a session are written as planned."""
    cell = load_cell(path)
    return replace(cell, model=cell.model.without_terms())


class LinkedJoints(JointSource):
    """Reads the arm over the cell's link; drives it where ``move`` allows."""

    watches = True

    def __init__(self, cell: Cell, settle: float, speed: float, folder: Path, move: bool) -> None:
        self._settle, self._speed, self._folder = settle, speed, folder
        self.drives = move
        self._settings = settings_of(cell).model_copy(
            update={
                "recording": RecordingSettings(folder=None), "web": None, "metrics": None,
                "setpoints": SetpointSettings(source="target"),
                "model_source": "gapbridge.bridge.calibration.joints.link:uncorrected",
                "uncorrected": True,
            }
        )  # fmt: skip
        self._run: WatchedRun | None = None

    def open(self) -> None:
        """Watch the arm. Raises LinkError where it cannot be reached."""
        self._start(self._settings, write=False)

    def close(self) -> None:
        """Leave the link."""
        run, self._run = self._run, None
        if run is not None:
            run.end()

    def now(self) -> Array | None:
        """Return the joints (n,) of the newest cycle."""
        rows = self._rows(0.1)
        return None if not len(rows) else np.asarray(rows[-1, self._part("actual_q")])

    def arrived(self, pose: PlannedPose) -> JointSample | None:
        """Return where the arm rests, once it does so near the pose."""
        now = self.now()
        if now is None or np.abs(now - pose.q).max() > NEAR or not self._rests():
            return None
        return self._standing()

    def stand(self, pose: PlannedPose) -> JointSample:
        """Return where the arm rests. Raises ReadingError where it moves or is pulled at."""
        until = time.monotonic() + max(5.0, 4.0 * self._settle)
        while time.monotonic() < until:
            if self._rests() and self._steady():
                return self._standing()
            time.sleep(0.02)
        why = "the force at the tool is not steady" if self._rests() else "the arm moves"
        raise ReadingError(f"{why}, expected it at rest for {self._settle:g} s")

    def still(self, stand: JointSample) -> bool:
        """Return whether the arm stands where it stood."""
        rows = self._rows(0.1)
        here = rows[:, self._part("actual_q")].mean(axis=0)
        return bool(np.abs(here - stand.q).max() < MOVED)

    def drive(self, pose: PlannedPose, via: Sequence[Array] = ()) -> None:
        """Move the arm to a pose, slowly, and wait until it rests there. Raises RunError."""
        if not self.drives:
            return super().drive(pose, via)
        begin = self.now()
        if begin is None:
            raise LinkError("the arm reports no joints, expected where it stands before a move")
        file = self._folder / "move.csv"
        length = write_move(file, [begin, *via, pose.q], self._speed)
        moving = SetpointSettings(source="trajectory", file=file.resolve())
        self.close()
        self._start(self._settings.model_copy(update={"setpoints": moving}), write=True)
        self._follow(pose, length)
        return None

    def _follow(self, pose: PlannedPose, length: float) -> None:
        """Wait until the arm rests at the pose, then have the daemon observe."""
        run = self._require()
        until = time.monotonic() + SLOWEST * length + PATIENCE
        begun, said = False, 0
        while True:
            state = run.daemon.state
            if not begun and state == State.COMPENSATING:
                begun, said = True, len(run.messages())
            if begun and not state.writes:
                why = "; ".join(run.messages(said)) or state.name.lower()
                raise RunError(f"the move broke off: {why}")
            now = self.now()
            there = now is not None and np.abs(now - pose.q).max() < NEAR / 10
            if begun and there and run.daemon.memory.ended and self._rests():
                break
            if time.monotonic() > until:
                run.end()
                raise RunError(f"the arm did not arrive within {SLOWEST * length + PATIENCE:.0f} s")
            time.sleep(0.02)
        run.daemon.disarm()
        while run.daemon.state.writes and time.monotonic() < until:
            time.sleep(0.02)

    # -- the watched arm --------------------------------------------------------------------------

    def _start(self, settings: DaemonSettings, write: bool) -> None:
        self._run = run = WatchedRun(settings, write)
        begun = time.monotonic()
        limit = settings.link.connect_timeout + PATIENCE
        until = begun + limit
        while not len(self._rows(1.0)):
            if run.daemon.phase == Phase.STARTING and time.monotonic() < begun + STARTING:
                until = time.monotonic() + limit  # imports, on a busy machine
            if time.monotonic() > until:
                raise LinkError("the arm reports nothing, expected its joints")
            time.sleep(0.02)

    def _require(self) -> WatchedRun:
        if self._run is None:
            raise LinkError("the link to the arm is closed")
        self._run.check()
        return self._run

    def _part(self, name: str) -> slice:
        return self._require().slices[name]

    def _rows(self, span: float) -> Array:
        """Return the cycles (M, width) of the last ``span`` s."""
        run = self._require()
        run.take()
        rows = run.rows
        if not len(rows):
            return rows
        time_at = rows[:, run.slices["timestamp"].start]
        return np.asarray(rows[time_at >= time_at[-1] - span])

    def _rests(self) -> bool:
        """Return whether the arm has stood still for the time of settling."""
        rows, at = self._rows(self._settle), self._part("timestamp").start
        whole = self._require().rows
        if whole[-1, at] - whole[0, at] < self._settle:
            return False
        return bool(np.abs(rows[:, self._part("actual_qd")]).max() < STILL)

    def _steady(self) -> bool:
        """Return whether the force at the tool does not drift; True where there is none."""
        force = self._rows(self._settle)[:, self._part("actual_TCP_force")][:, :3]
        if not np.isfinite(force).all() or len(force) < 8:
            return True
        first, last = np.array_split(force, 2)
        noise = force.std(axis=0) * np.sqrt(4.0 / len(force))
        drift = np.abs(last.mean(axis=0) - first.mean(axis=0))
        return bool((drift < STEADY + 3.0 * noise).all())

    def _standing(self) -> JointSample:
        rows, run = self._rows(self._settle), self._require()

        def mean(name: str) -> Array | None:
            found = rows[:, run.slices[name]].mean(axis=0)
            return found if np.isfinite(found).all() else None

        q, payload = mean("actual_q"), mean("payload")
        assert q is not None
        return JointSample(
            q=q,
            temperature=mean("joint_temperatures"),
            wrench=mean("actual_TCP_force"),
            raw_wrench=mean("ft_raw_wrench"),
            payload=None if payload is None else float(payload[0]),
            approach=run.approach.copy(),
        )


def write_move(path: Path, stops: Sequence[Array], speed: float) -> float:
    """Write the move from stop to stop, at rest in each, as the daemon's trajectory.

    All joints together, the fastest at most ``speed`` rad/s. Returns how long it takes, s.
    """
    parts = []
    for begin, end in pairwise(stops):
        duration = max(quintic_time(end - begin, speed, ACCELERATION), SHORTEST)
        parts.append(quintic(begin, end, int(np.ceil(duration / PERIOD))))
        parts.append(np.tile(end, (int(HOLD / PERIOD), 1)))
    return write_trajectory(path, np.vstack(parts), PERIOD)


class WatchedRun:
    """One run of the daemon in a thread of its own."""

    def __init__(self, settings: DaemonSettings, write: bool) -> None:
        self.daemon = Daemon(settings, may_write=write, say=self._say)
        self.slices = self.daemon.memory.slices
        self.rows = np.empty((0, self.daemon.memory.width))
        self.approach = np.zeros(self.daemon.memory.n)
        self._turned_at: Array | None = None
        self._reader: CycleReader | None = self.daemon.memory.reader()
        self._messages: list[str] = []
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._main, args=(write,), daemon=True)
        self._thread.start()

    def _say(self, text: str) -> None:
        self._messages.append(text)

    def _main(self, write: bool) -> None:
        try:
            self.daemon.run(arm=write, duration=FOREVER, by="--arm")
        except BaseException as error:
            self._error = error

    def message(self) -> str:
        """Return what the daemon said last."""
        return self._messages[-1] if self._messages else ""

    def messages(self, since: int = 0) -> list[str]:
        """Return what the daemon said, from the message of that number on."""
        return self._messages[since:]

    def check(self) -> None:
        """Raise what ended the run."""
        if self._thread.is_alive():
            return
        if isinstance(self._error, GapbridgeError):
            raise self._error
        raise LinkError(
            f"the link to the arm ended: {self._error or self.message() or 'no reason'}"
        )

    def take(self) -> None:
        """Take the cycles over that came since the last call."""
        if self._reader is None:
            return
        try:
            new = self._reader.drain()
        except (IndexError, ValueError):  # the memory was closed meanwhile
            return
        if not len(new):
            return
        at = self.slices["timestamp"].start
        self._follow_motion(new[:, self.slices["actual_q"]])
        rows = np.vstack([self.rows, new])
        self.rows = rows[rows[:, at] >= rows[-1, at] - KEPT]

    def _follow_motion(self, q: Array) -> None:
        before = q[0].copy() if self._turned_at is None else self._turned_at
        for row in q:
            way = row - before
            moved = np.abs(way) > STEP
            self.approach[moved] = np.sign(way[moved])
            before[moved] = row[moved]
        self._turned_at = before

    def end(self) -> None:
        """End the run."""
        self._reader = None
        self.daemon.stop()
        self._thread.join(20.0)
