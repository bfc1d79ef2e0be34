"""The daemon itself: asked to end, killed, or given a cell that does not fit its controller."""

from __future__ import annotations

import math
import signal
import time
from pathlib import Path

import psutil

from benchmarks.faults.links import Link
from benchmarks.faults.process_run import END_LIMIT, ProcessRun
from benchmarks.faults.rig import RECOVERY_LIMIT, START_LIMIT, Rig
from benchmarks.faults.row import Apart, Result, Row, seconds
from benchmarks.faults.running import Running
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers import modbus

PROFILES = Path(modbus.__path__[0]) / "profiles"
LONGEST_END = 1.8  # s from SIGTERM to the end, on a busy machine: 1 s of ramp, 0.4 s of patience
ON_THE_WIRE = 0.1  # s in which what has left reaches the tap
AFTER = 0.5  # s of compensating before the signal


class ProcessRig(Rig):
    """A rig whose daemon is a process, armed from the beginning."""

    ended: ProcessRun

    def start_daemon(self) -> None:
        """Start one and wait until it compensates."""
        self.link.prepare(self.controller, self.back)
        self.ended = ProcessRun(self.cell)
        self._runs.append(self.ended)  # type: ignore[arg-type]
        self.ended.start()
        self.wait(State.COMPENSATING, START_LIMIT)


def ended_by(number: signal.Signals) -> Apart:
    """Return a way to end the daemon: its offset must go, it must be gone and start anew."""

    def run(row: Row, link: Link, folder: Path) -> Result:
        with ProcessRig(link, folder) as rig:
            rig.pass_time(AFTER)
            found, run, wrong = rig.found, rig.ended, list[str]()
            found.largest_step = 0.0
            moment = time.monotonic()
            processes = run.send(number)
            detected = _wait(rig, lambda: run.state != State.COMPENSATING, 2.0, moment)
            gone = _wait(rig, lambda: not any(map(_lives, processes.values())), END_LIMIT, moment)
            if detected is None or detected > row.within(link):
                wrong.append(f"compensating ended after {detected} s")
            if gone is None or (number == signal.SIGTERM and gone > LONGEST_END):
                wrong.append(f"its processes ended after {gone} s")
            _wait(rig, lambda: run.exit_code is not None, END_LIMIT, moment)
            if number == signal.SIGTERM and run.exit_code != 0:
                wrong.append(f"it ended with {run.exit_code}: {run.output[-200:]}")
            rig.pass_time(ON_THE_WIRE)
            found = rig.found
            left = math.hypot(*rig.checker.last_offset[:3])
            # where joints are written, an arm that stays where it is is all that is wanted
            if left > 5.0 * rig.checker.bounds.grain and not link.moves_arm:
                words = f"an offset of {1e6 * left:.1f} um was left behind in {run.state.name}"
                counted = {name: count for name, count in run.memory.counts().items() if count}
                wrong.append(f"{words}; {counted}: {run.output[-900:]}")
            step, late = found.largest_step, rig.witness.late(moment)
            rig.link.prepare(rig.controller, rig.back)
            rig.start_daemon()  # with what the former has left behind: nothing is cleaned
            rig.pass_time(AFTER)
            wrong += rig.found.violations
            bounds = rig.checker.bounds
            return Result(
                row.key, link.name, link.cycle, detected, "ended", step,
                bounds.offset_rate * bounds.cycle, tuple(wrong), bool(rig.found.violated), late,
            )  # fmt: skip

    return run


def _wait(rig: Rig, what, limit: float, moment: float) -> float | None:  # type: ignore[no-untyped-def]
    while time.monotonic() - moment < limit:
        if what():
            return time.monotonic() - moment
        rig.pass_time(0.001)
    return None


def _lives(process: psutil.Process) -> bool:
    try:
        return str(process.status()) != psutil.STATUS_ZOMBIE
    except psutil.Error:
        return False


class Misfit(Rig):
    """A rig whose daemon is given a changed link."""

    change = ("", "")

    def start_daemon(self) -> None:
        """Start it; it cannot succeed."""
        units = (PROFILES / "ur.yaml").read_text(encoding="utf-8")
        assert "unit: mrad, turns" in units
        wrong = units.replace("unit: mrad, turns", "unit: deg, turns")
        (self.cell.parent / "wrong_units.yaml").write_text(wrong, encoding="utf-8")
        text = self.cell.read_text(encoding="utf-8")
        assert self.change[0] in text
        self.cell.write_text(text.replace(*self.change), encoding="utf-8")
        self._runs.append(Running(self.cell))
        self.run.start()


def misfit(before: str, after: str) -> Apart:
    """Return a way to run a daemon with a link that is not its controller's."""

    def run(row: Row, link: Link, folder: Path) -> Result:
        rig = Misfit(link, folder)
        rig.change = (before, after)
        with rig:
            begun = time.monotonic()
            _wait(rig, lambda: not rig.run.alive, START_LIMIT + RECOVERY_LIMIT, begun)
            error, wrong = rig.run.error, list[str]()
            if not isinstance(error, GapbridgeError):
                wrong.append(f"it was not refused: {error!r}, {rig.run.last_words()}")
            if "\n" in str(error):
                wrong.append(f"more than one line: {error}")
            if rig.found.writes or rig.found.violated:
                wrong.append(f"{rig.found.writes} setpoints were written: {rig.found.violations}")
            bounds = rig.checker.bounds
            return Result(
                row.key, link.name, link.cycle, None, "refused", 0.0,
                bounds.offset_rate * bounds.cycle, tuple(wrong), bool(rig.found.violated),
            )  # fmt: skip

    return run


ROWS = (
    Row("SIGTERM", "daemon SIGTERM", "SIGTERM of the daemon while it compensates; started anew",
        within=seconds(0.3), end=("ended",), apart=ended_by(signal.SIGTERM)),
    Row("SIGKILL", "daemon SIGKILL", "SIGKILL of the daemon while it compensates; started anew",
        within=seconds(0.3), end=("ended",), apart=ended_by(signal.SIGKILL)),
    Row("another map", "register map of another controller", "profile of another make",
        None, ("modbus",), end=("refused",), apart=misfit("profile: ur", "profile: jaka")),
    Row("wrong units", "misconfigured register map", "profile with degrees for milliradians",
        None, ("modbus",), end=("refused",),
        apart=misfit("profile: ur", "profile: wrong_units.yaml")),
)  # fmt: skip
