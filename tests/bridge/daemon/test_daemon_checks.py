"""The checks of every cycle on the real wire: what is found, what follows, what stays."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets, wait_for

from bridge.loop.supervisor import State

PATIENT = ", state_timeout: 0.2"


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


def test_an_offset_that_stands_at_its_limit_ends_the_compensation(robot: Robot) -> None:
    cell = robot.cell(PATIENT, limits="{offset: 0.0002}")
    with Run(cell, arm=True) as run:
        run.wait(State.COMPENSATING)

        def saturated() -> bool:
            if run.daemon.state == State.OBSERVING:
                run.daemon.arm()  # a busy machine was late, and the loop held before its second
            return "offset saturated" in " ".join(run.said)

        wait_for(saturated, 30.0, "the saturation")
        run.wait(State.OBSERVING, 5.0)
        assert run.daemon.status()["counts"]["saturated"] == 1
        run.end()
        moved = np.linalg.norm(offsets(run.cycles())[:, :3], axis=1)
    assert moved.max() <= 2e-4 * (1 + 1e-9)
    assert moved[-1] == 0.0


def test_a_loop_that_was_suspended_begins_anew_and_observes(robot: Robot) -> None:
    with Run(robot.cell(PATIENT), arm=True) as run:
        run.wait(State.COMPENSATING)
        time.sleep(0.5)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, signal.SIGSTOP)
        time.sleep(0.4)
        os.kill(pid, signal.SIGCONT)
        wait_for(lambda: not run.daemon.state.writes, 5.0, "no more writing")
        run.wait(State.OBSERVING, 90.0)
        time.sleep(0.3)
        assert run.daemon.state == State.OBSERVING
        assert run.daemon.latched == ""
        run.end()
        cycles = run.cycles()
    moved, written = offsets(cycles)[:, :3], cycles["written"] > 0
    steps = np.linalg.norm(np.diff(moved, axis=0), axis=1)
    # the robot's own watchdog may have ended its program meanwhile: then nothing more is written
    assert steps[written[1:] & written[:-1]].max() <= 0.05 * 0.002 * 5.001
