"""A changed cell file is taken whole or not at all, and never with a jump."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from patience import wait_for

from gapbridge.bridge.ipc.loop_state import State

pytestmark = pytest.mark.usefixtures("runtime")

PATIENT = ", state_timeout: 0.25"


def configured(run: Run) -> dict[str, Any]:
    """Return the event of the last attempt."""
    wait_for(lambda: bool(run.daemon.status()["configured"]), "the cell read again")
    found: dict[str, Any] = run.daemon.status()["configured"]
    return found


@pytest.mark.slow
def test_a_wrong_cell_changes_nothing_and_everything_wrong_is_reported(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell, arm=True) as run:
        run.compensate()
        pid, before = run.daemon.loop_pid, run.daemon.status()["configuration_hash"]
        text = cell.read_text().replace("mass: 5.0", "mass: heavy") + "limits: {offset: -1}\n"
        cell.write_text(text + "recoding: {}\n")
        run.daemon.reload()
        event = configured(run)
        assert not event["ok"]
        for part in ("payload.mass: found 'heavy'", "limits.offset: found -1", "recoding"):
            assert part in event["detail"]
        time.sleep(0.3)
        assert run.daemon.state == State.COMPENSATING
        assert run.daemon.loop_pid == pid
        assert run.daemon.status()["configuration_hash"] == before
        assert run.end().restarts == 0


@pytest.mark.slow
def test_another_robot_or_another_arm_needs_a_new_start(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        cell.write_text(cell.read_text().replace(robot.host, "192.0.2.1"))
        run.daemon.reload()
        event = configured(run)
        assert not event["ok"]
        assert "192.0.2.1" in event["detail"]
        assert run.daemon.settings.link.host == robot.host  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("arms", [False, True])
def test_a_changed_cell_is_ramped_out_of_and_into(robot: Robot, arms: bool) -> None:
    section = "{arm: true}" if arms else "{arm: false}"
    cell = robot.cell(PATIENT, setpoints=section)
    with Run(cell, arm=True) as run:
        run.compensate()
        time.sleep(0.8)
        first, before = run.daemon.loop_pid, run.daemon.status()["configuration_hash"]
        cell.write_text(cell.read_text() + "limits: {offset_rate: 0.02}\n")
        run.daemon.reload()
        assert configured(run)["ok"]
        wait_for(lambda: run.daemon.loop_pid not in (None, first), "the new loop")
        run.wait(State.COMPENSATING if arms else State.OBSERVING)
        time.sleep(1.0)
        assert run.daemon.state == (State.COMPENSATING if arms else State.OBSERVING)
        assert run.daemon.status()["configuration_hash"] != before
        summary = run.end()
        cycles = run.cycles()
    assert summary.restarts == 0
    assert not [line for line in run.output if "state stale" in line]
    moved = np.linalg.norm(offsets(cycles)[:, :3], axis=1)
    assert moved.max() > 4e-4
    assert np.abs(np.diff(moved)).max() <= 0.05 * 0.002 * 5.001
    second = np.array(cycles["loop"]) > 0
    assert np.abs(np.diff(moved[second])).max() <= 0.02 * 0.002 * 5.001
    assert (moved[second].max() > 4e-4) == arms


@pytest.mark.slow
def test_a_reload_while_observing_takes_effect_at_once(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        first = run.daemon.loop_pid
        cell.write_text(cell.read_text().replace("mass: 5.0", "mass: 4.0"))
        run.daemon.reload()
        assert configured(run)["ok"]
        wait_for(lambda: run.daemon.loop_pid not in (None, first), "the new loop")
        run.wait(State.OBSERVING)
        assert run.end().setpoints_written == 0
