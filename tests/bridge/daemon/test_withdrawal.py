"""Every end takes the offset out at the cell's own rates: while we live, and after that."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from further import further
from patience import wait_for

from gapbridge.bridge.ipc.loop_state import State

RATE = 0.0005  # m/s: a hundredth of what the robot's program would allow
LIMITS = (
    f"{{offset: 0.002, offset_rate: {RATE}, offset_rotation: 0.005, offset_rotation_rate: 0.05}}"
)
CYCLE = 0.008


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found, found.start_offset_program():
        yield found


def shift(robot: Robot, start: np.ndarray) -> float:
    return float(np.linalg.norm(np.array(robot.truth()["rigid_tcp"][:3]) - start))


def compensating(run: Run, robot: Robot, start: np.ndarray) -> float:
    """Wait until a fifth of a millimetre is in the arm; returns it."""
    run.compensate()
    wait_for(lambda: shift(robot, start) > 2e-4, "an offset")
    return shift(robot, start)


def path_of(robot: Robot, start: np.ndarray, until: float) -> np.ndarray:
    """Return (N, 2) time and shift of the rigid TCP until it is nearly back."""
    rows = [(time.monotonic(), shift(robot, start))]
    while rows[-1][1] > 1e-6:
        assert time.monotonic() - rows[0][0] < until, rows[-1]
        rows.append((time.monotonic(), shift(robot, start)))
    return np.array(rows)


def assert_no_faster(rows: np.ndarray) -> None:
    """No stretch goes faster than the cell's rate; a reading may be 20 ms old."""
    times, lengths = rows.T
    for first in range(0, len(rows), 10):
        fallen = lengths[first] - lengths[first:]
        assert (fallen <= RATE * (times[first:] - times[first] + 0.03) + 1e-6).all()


@pytest.mark.realtime(limit=0.03)
@pytest.mark.parametrize("number", [signal.SIGKILL, *further(signal.SIGSEGV)])
def test_after_a_killed_loop_the_robots_program_withdraws_at_the_cells_rate(
    robot: Robot, number: signal.Signals
) -> None:
    start = np.array(robot.truth()["rigid_tcp"][:3])
    with Run(robot.cell(", mode: offset, rate: 125", limits=LIMITS), arm=True) as run:
        compensating(run, robot, start)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, number)
        rows = path_of(robot, start, 6.0)
        assert_no_faster(rows)
        assert rows[-1, 0] - rows[0, 0] > 0.9 * 2e-4 / RATE


@pytest.mark.slow
@pytest.mark.realtime(limit=0.03)
def test_a_stop_takes_the_time_that_the_cells_rate_needs(robot: Robot) -> None:
    start = np.array(robot.truth()["rigid_tcp"][:3])
    with Run(robot.cell(", mode: offset, rate: 125", limits=LIMITS), arm=True) as run:
        run.compensate()
        wait_for(lambda: shift(robot, start) > 6e-4, "an offset")  # over a second's worth
        run.daemon.stop()
        assert_no_faster(path_of(robot, start, 6.0))
        summary = run.join()
    assert summary.exit_code == 0
    moved = offsets(run.cycles())
    steps = np.linalg.norm(np.diff(moved[:, :3], axis=0), axis=1)
    assert steps.max() <= RATE * CYCLE * 5.001
    assert np.linalg.norm(moved[-1]) == 0.0


@pytest.mark.realtime(limit=0.03)
def test_a_fault_sends_no_zero_and_the_robots_program_withdraws(robot: Robot) -> None:
    start = np.array(robot.truth()["rigid_tcp"][:3])
    with Run(robot.cell(", mode: offset, rate: 125", limits=LIMITS), arm=True) as run:
        compensating(run, robot, start)
        robot.bench("stall 0.5")
        rows = path_of(robot, start, 6.0)
        assert_no_faster(rows)
        wait_for(lambda: run.daemon.state != State.COMPENSATING, "the end")
