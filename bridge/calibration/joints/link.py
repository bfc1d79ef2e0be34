"""Joint angles through the daemon, which observes the arm and moves it only in ``move_to``.

A run of the daemon that writes follows one trajectory from the present joints to the next pose,
through the limiter, without corrections; once the arm rests there the daemon only observes.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import ReadingError
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.daemon.daemon import Daemon
from gapbridge.bridge.ipc.events import Event, EventKind
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import CycleReader, Phase
from gapbridge.bridge.setpoint_source.quintic import quintic, quintic_time, write_trajectory
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import GapbridgeError, LinkError, RunError
from gapbridge.drivers.clock import Clock

MAX_REST_SPEED = 0.003  # rad/s, of any joint of an arm at rest
ARRIVAL_TOLERANCE = 0.05  # rad, of any joint
MOTION_THRESHOLD = 2e-4  # rad: a larger change of a joint is a motion
MAX_FORCE_DRIFT = 1.0  # N over the settling time, noise excluded
LINK_MARGIN = 30.0  # s added to the link's connect_timeout, and to the time of a move
START_TIMEOUT = 180.0  # s for the loop's process
MAX_SLOWDOWN = 4.0  # actual over planned duration of a move
PERIOD = 0.01  # s between rows; the daemon interpolates linearly
ACCELERATION = 1.0  # rad/s2, of the fastest joint
MIN_DURATION = 0.5  # s of a move
DWELL = 0.2  # s at the end of a move
BUFFER_SPAN = 5.0  # s of cycles in memory, beyond the time in which the arm settles
MEAN_SPAN = 0.1  # s of cycles, in whose mean a motion is told from noise
SILENCE = 0.5  # s without a cycle after which it is unknown where the arm is
DIRECTION_THRESHOLD = 1e-5  # rad: least motion that sets the approach direction
ACTIVE = (State.ARMED.name, State.COMPENSATING.name, State.HOLDING.name)
UNLIMITED = 1e9  # s, duration of a run


def uncorrected(path: Path) -> Cell:
    """Return a cell without effects: poses of a session are written as planned."""
    cell = load_cell(path)
    return replace(cell, model=cell.model.without_terms())


class LinkedJoints(JointSource):
    """Reads the arm over the cell's link; moves it if ``move`` is set."""

    detects_rest = True

    def __init__(
        self, cell: Cell, settle: float, speed: float, folder: Path, move: bool, clock: Clock
    ) -> None:
        self._clock = clock
        self._settle, self._speed, self._folder = settle, speed, folder
        self.can_move = move
        self._settings = settings_of(cell).model_copy(
            update={
                "recording": RecordingSettings(folder=None), "web": None, "metrics": None,
                "setpoints": SetpointSettings(source="target"),
                "model_source": "gapbridge.bridge.calibration.joints.link:uncorrected",
                "uncorrected": True,
            }
        )  # fmt: skip
        self._run: DaemonRun | None = None

    def open(self) -> None:
        """Observe the arm. Raises LinkError if it cannot be reached."""
        self._start(self._settings, write=False)

    def close(self) -> None:
        """Close the link."""
        run, self._run = self._run, None
        if run is not None:
            run.stop()

    def current_q(self) -> Array | None:
        """Return the joint angles (n,), rad, of the newest cycle; None while the link is silent."""
        try:
            rows = self._recent_cycles(MEAN_SPAN)
        except ReadingError:
            return None
        return np.asarray(rows[-1, self._columns("actual_q")])

    def arrived(self, pose: PlannedPose) -> JointSample | None:
        """Return a sample once the arm is at rest near the pose; None before."""
        q = self.current_q()
        if q is None or np.abs(q - pose.q).max() > ARRIVAL_TOLERANCE or not self._at_rest():
            return None
        return self._sample()

    def sample_at_rest(self, pose: PlannedPose) -> JointSample:
        """Return a sample.

        Raises ReadingError if the arm moves, its force is not steady, or the link is silent.
        """
        until = self._clock.monotonic() + max(5.0, 4.0 * self._settle)
        while self._clock.monotonic() < until:
            if self._at_rest() and self._force_steady():
                return self._sample()
            self._clock.sleep(0.02)
        self._recent_cycles(0.0)  # raises if the link is silent
        why = "the force at the tool is not steady" if self._at_rest() else "the arm moves"
        raise ReadingError(f"{why}, expected it at rest for {self._settle:g} s")

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Read the cycles while the block runs: it may last longer than the memory holds."""
        run, ended = self._active_run(), False

        def watch() -> None:
            while not ended:
                run.read_cycles()
                self._clock.sleep(MEAN_SPAN)

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended = True
            thread.join()  # cycles are read by one thread at a time

    def unmoved_since(self, sample: JointSample) -> bool:
        """Return whether the arm has rested at the newest sample; raises ReadingError: unknown."""
        rows, run = self._recent_cycles(MEAN_SPAN), self._active_run()
        q = rows[:, self._columns("actual_q")].mean(axis=0)
        if run.interrupted:
            raise ReadingError("the link was interrupted, expected the arm's joints throughout")
        return not run.left and bool(np.abs(q - sample.q).max() < MOTION_THRESHOLD)

    def move_to(self, pose: PlannedPose, via: Sequence[Array] = ()) -> None:
        """Move the arm to a pose at ``speed`` and wait until it rests there.

        Raises RunError if that fails: the daemon only observes then. LinkError: it cannot even.
        """
        if not self.can_move:
            return super().move_to(pose, via)
        begin = self.current_q()
        if begin is None:
            raise RunError("the arm reports no joints, expected where it stands before a move")
        file = self._folder / "move.csv"
        duration = write_move(file, [begin, *via, pose.q], self._speed)
        moving = SetpointSettings(source="trajectory", file=file.resolve())
        self.close()
        try:
            self._start(self._settings.model_copy(update={"setpoints": moving}), write=True)
            self._wait_for_arrival(pose, duration)
        except RunError as error:
            self._observe_after(error)
        return None

    def _observe_after(self, error: RunError) -> NoReturn:
        """Observe the arm after a failed move, and raise the error; LinkError if that fails too."""
        self.close()
        try:
            self.open()
        except LinkError as lost:
            raise LinkError(f"{error}; {lost}") from error
        raise RunError(str(error)) from error

    def _wait_for_arrival(self, pose: PlannedPose, duration: float) -> None:
        """Wait until the arm rests at the pose, then disarm the daemon. Raises RunError."""
        run = self._active_run()
        limit = MAX_SLOWDOWN * duration + LINK_MARGIN
        until = self._clock.monotonic() + limit
        while True:
            if run.failure:
                raise RunError(f"the move failed: {run.failure}")
            q = self.current_q()
            at_pose = q is not None and np.abs(q - pose.q).max() < ARRIVAL_TOLERANCE / 10
            if at_pose and run.daemon.memory.ended and self._at_rest():
                break
            if self._clock.monotonic() > until:
                raise RunError(f"the arm did not arrive within {limit:.0f} s")
            self._clock.sleep(0.02)
        run.daemon.disarm()
        while run.daemon.state.writes and self._clock.monotonic() < until:
            self._clock.sleep(0.02)

    # -- cycles of the daemon ----------------------------------------------------------------------

    def _start(self, settings: DaemonSettings, write: bool) -> None:
        self._run = run = DaemonRun(settings, write, self._clock, self._settle)
        started = self._clock.monotonic()
        limit = settings.link.connect_timeout + LINK_MARGIN
        until = started + limit
        while self.current_q() is None:
            now = self._clock.monotonic()
            if run.daemon.phase == Phase.STARTING and now < started + START_TIMEOUT:
                until = now + limit  # slow imports on a busy machine
            if now > until:
                raise LinkError("the arm reports nothing, expected its joints")
            self._clock.sleep(0.02)

    def _active_run(self) -> DaemonRun:
        if self._run is None:
            raise LinkError("the link to the arm is closed")
        self._run.check()
        return self._run

    def _columns(self, name: str) -> slice:
        return self._active_run().slices[name]

    def _recent_cycles(self, span: float) -> Array:
        """Return the cycles (M, width) of the last ``span`` s, at least one.

        Raises ReadingError while the link is silent: the arm may be elsewhere by now.
        """
        run = self._active_run()
        run.read_cycles()
        rows = run.rows
        if not len(rows) or run.daemon.state == State.DISCONNECTED:
            raise ReadingError("the link to the arm is down, expected the arm's joints")
        silent = self._clock.monotonic() - rows[-1, run.slices["received"].start]
        if silent > SILENCE:
            raise ReadingError(
                f"the controller has reported nothing for {silent:.1f} s, expected the arm's joints"
            )
        time_at = rows[:, run.slices["timestamp"].start]
        return np.asarray(rows[time_at >= time_at[-1] - span])

    def _at_rest(self) -> bool:
        """Return whether the arm has not moved for the settling time; False if it is silent."""
        try:
            rows, time_column = self._recent_cycles(self._settle), self._columns("timestamp").start
        except ReadingError:
            return False
        buffer = self._active_run().rows
        if buffer[-1, time_column] - buffer[0, time_column] < self._settle:
            return False
        return bool(np.abs(rows[:, self._columns("actual_qd")]).max() < MAX_REST_SPEED)

    def _force_steady(self) -> bool:
        """Return whether the TCP force does not drift; True if no force is reported."""
        force = self._recent_cycles(self._settle)[:, self._columns("actual_TCP_force")][:, :3]
        if not np.isfinite(force).all() or len(force) < 8:
            return True
        first, last = np.array_split(force, 2)
        noise = force.std(axis=0) * np.sqrt(4.0 / len(force))
        drift = np.abs(last.mean(axis=0) - first.mean(axis=0))
        return bool((drift < MAX_FORCE_DRIFT + 3.0 * noise).all())

    def _sample(self) -> JointSample:
        rows, run = self._recent_cycles(self._settle), self._active_run()

        def mean(name: str) -> Array | None:
            values = rows[:, run.slices[name]].mean(axis=0)
            return values if np.isfinite(values).all() else None

        q, payload = mean("actual_q"), mean("payload")
        assert q is not None
        run.rest_at(q)
        return JointSample(
            q=q,
            temperature=mean("joint_temperatures"),
            wrench=mean("actual_TCP_force"),
            raw_wrench=mean("ft_raw_wrench"),
            payload=None if payload is None else float(payload[0]),
            approach=run.approach.copy(),
        )


def write_move(path: Path, stops: Sequence[Array], speed: float) -> float:
    """Write a move through ``stops``, each (n,) rad, at rest in each, as the daemon's trajectory.

    All joints move together, the fastest at most at ``speed`` rad/s. Returns the duration, s.
    """
    parts = []
    for begin, end in pairwise(stops):
        duration = max(quintic_time(end - begin, speed, ACCELERATION), MIN_DURATION)
        parts.append(quintic(begin, end, int(np.ceil(duration / PERIOD))))
        parts.append(np.tile(end, (int(DWELL / PERIOD), 1)))
    return write_trajectory(path, np.vstack(parts), PERIOD)


class DaemonRun:
    """One run of the daemon in a thread, with a buffer of its last cycles."""

    def __init__(
        self, settings: DaemonSettings, write: bool, clock: Clock, settle: float = 0.0
    ) -> None:
        self._span = settle + BUFFER_SPAN
        self.daemon = Daemon(settings, write, clock, self._say, self._note)
        self.slices = self.daemon.memory.slices
        self.rows = np.empty((0, self.daemon.memory.width))
        self.approach = np.zeros(self.daemon.memory.n)
        self._last_moved: Array | None = None  # (n,) rad, where each joint last moved to
        self._rest: tuple[float, Array] | None = None  # controller's s, (n,) rad of a sample
        self.left = False  # the arm has been elsewhere since the sample
        self.interrupted = False  # nothing is known of the arm for a while since the sample
        self._reader: CycleReader | None = self.daemon.memory.reader()
        self._messages: list[str] = []
        self._mark = 0  # number of the first message since it was armed, or began to write
        self.failure = ""  # why the daemon did not begin to write, or has ceased
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._main, args=(write,), daemon=True)
        self._thread.start()

    def _say(self, text: str) -> None:
        self._messages.append(text)

    def _note(self, event: Event) -> None:
        """Note why the daemon does not write; its message of the event has been said before."""
        kind, before, after = event["kind"], event.get("from"), event.get("to")
        if after in (State.ARMED.name, State.COMPENSATING.name):
            self._mark = len(self._messages)
        elif kind == EventKind.TRANSITION and before in ACTIVE and after != State.HOLDING.name:
            self.failure = "; ".join(self._messages[self._mark :])
        elif kind == EventKind.FAULT or (kind == EventKind.REFUSED and event.get("what") == "arm"):
            self.failure = str(event["detail"])

    def _main(self, write: bool) -> None:
        try:
            self.daemon.run(arm=write, duration=UNLIMITED, by="--arm")
        except BaseException as error:
            self._error = error

    def message(self) -> str:
        """Return the last message of the daemon."""
        return self._messages[-1] if self._messages else ""

    def check(self) -> None:
        """Raise the error that ended the run, LinkError if it ended without one."""
        if self._thread.is_alive():
            return
        if isinstance(self._error, GapbridgeError):
            raise self._error
        raise LinkError(
            f"the link to the arm ended: {self._error or self.message() or 'no reason'}"
        )

    def read_cycles(self) -> None:
        """Add the cycles since the last call to the buffer."""
        if self._reader is None:
            return
        try:
            new = self._reader.drain()
        except (IndexError, ValueError):  # the memory was closed by another thread
            return
        if not len(new):
            return
        self._update_approach(new[:, self.slices["actual_q"]])
        rows = np.vstack([self.rows, new])
        timestamp, received, loop = (
            rows[:, self.slices[name].start] for name in ("timestamp", "received", "loop")
        )
        # what came before another process, a restarted controller or a gap is of another time
        breaks = (np.diff(loop) != 0) | (np.diff(timestamp) < 0) | (np.diff(received) > SILENCE)
        recent = timestamp >= timestamp[-1] - self._span
        recent[: np.append(0, np.flatnonzero(breaks) + 1)[-1]] = False
        self.rows = rows[recent]
        self.interrupted |= bool(breaks.any())
        self._note_motion()

    def rest_at(self, q: Array) -> None:
        """Note where the arm rests from now on, (n,) rad, and forget that it moved before."""
        self._rest = float(self.rows[-1, self.slices["timestamp"].start]), q
        self.left = self.interrupted = False

    def _note_motion(self) -> None:
        """Note whether the arm has left where it rested, in the mean of any MEAN_SPAN."""
        if self._rest is None or self.interrupted:
            return
        since, rest = self._rest
        timestamp = self.rows[:, self.slices["timestamp"].start]
        rows, span = self.rows[timestamp > since], timestamp[timestamp > since] // MEAN_SPAN
        begins = np.flatnonzero(np.diff(span)) + 1  # of whole spans, and of the present one
        if len(begins) > 1:
            sums = np.add.reduceat(rows[:, self.slices["actual_q"]], begins)[:-1]
            means = sums / np.diff(begins)[:, None]
            self.left |= bool(np.abs(means - rest).max() > MOTION_THRESHOLD)

    def _update_approach(self, q: Array) -> None:
        last = q[0].copy() if self._last_moved is None else self._last_moved
        for row in q:
            change = row - last
            moved = np.abs(change) > DIRECTION_THRESHOLD
            self.approach[moved] = np.sign(change[moved])
            last[moved] = row[moved]
        self._last_moved = last

    def stop(self) -> None:
        """Stop the daemon and wait for its thread."""
        self._reader = None
        self.daemon.stop()
        self._thread.join(20.0)
