"""A cell edited while the daemon runs changes nothing, whatever becomes of the loop."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import Robot, Run, offsets
from patience import wait_for

from gapbridge.bridge.cell.run_settings import read_configuration
from gapbridge.bridge.daemon.processes import LoopProcess
from gapbridge.bridge.ipc.command_memory import CommandMemory
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import RunMemory
from gapbridge.bridge.loop.loop import Exit
from gapbridge.drivers.clock import SYSTEM

PATIENT = ", state_timeout: 0.25"


def granted(run: Run) -> list[str]:
    """Return the hash of the cell that each process of the loop runs."""
    return [e["hash"] for e in run.daemon.events_since(0) if e["kind"] == "granted"]


@pytest.mark.slow
def test_a_loop_that_is_started_anew_runs_the_cell_that_runs_not_the_edited_one(
    tmp_path: Path,
) -> None:
    with Robot(tmp_path) as robot:
        cell = robot.cell(PATIENT)
        text = cell.read_text()
        with Run(cell) as run:
            run.wait(State.OBSERVING)
            wait_for(lambda: granted(run), "the grant of the first loop")
            before = granted(run)
            run.compensate()
            wait_for(lambda: run.daemon.tally.counts.written > 400, "a ramp")
            # an arm ten times as soft as the one that stands there: the model is what is read anew
            soft = [10.0 * c for c in robot.settings.plant.axial]
            axial = str(list(robot.settings.plant.axial))
            assert axial in text
            cell.write_text(text.replace(axial, str(soft)))
            pid = run.daemon.loop_pid
            assert pid is not None
            os.kill(pid, 9)
            run.wait(State.DISCONNECTED)
            run.wait(State.OBSERVING)
            written = run.daemon.tally.counts.written
            run.compensate()
            wait_for(lambda: run.daemon.tally.counts.written > written + 400, "a ramp")
            assert run.daemon.configuration.text == text
            assert len(granted(run)) == 2
            assert granted(run)[-1] == before[-1] == run.daemon.configuration.hash
            run.daemon.reload()  # and a reload does take it
            wait_for(lambda: run.daemon.configuration.text != text, "the edited cell")
            wait_for(lambda: len(granted(run)) >= 3, "its loop")
            assert granted(run)[-1] != before[-1]
            run.end()
        cycles = run.cycles()
    size = np.linalg.norm(offsets(cycles)[:, :3], axis=1)
    first, second = (size[cycles["loop"] == k].max() for k in (0, 1))
    assert first > 3e-4
    assert abs(second - first) < 0.1 * first


@pytest.mark.slow
def test_a_loop_reads_none_of_the_files_that_a_cell_names_from_the_disk(tmp_path: Path) -> None:
    """The files are gone while the loop is started anew, and it runs on."""
    with Robot(tmp_path) as robot:
        start = np.array(robot.settings.start_q)
        rows = np.column_stack([[0.0, 5.0], [start, start]])
        header = ",".join(["timestamp", *(f"target_q_{i}" for i in range(6))])
        way = tmp_path / "way.csv"
        np.savetxt(way, rows, "%.9g", ",", header=header, comments="")
        cell = robot.cell(PATIENT, setpoints="{source: trajectory, file: way.csv}")
        with Run(cell) as run:
            run.wait(State.OBSERVING)
            way.unlink()
            cell.unlink()
            pid = run.daemon.loop_pid
            assert pid is not None
            os.kill(pid, 9)
            run.wait(State.DISCONNECTED)
            run.wait(State.OBSERVING)
            run.compensate()


def test_a_loop_starts_without_its_cells_files_on_the_disk(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        "robot: {model: ur10e}\nlink: {driver: modbus, profile: ur, host: 127.0.0.1, port: 1}\n"
    )
    configuration = read_configuration(cell)
    cell.unlink()
    memory, commands = RunMemory(6, clock=SYSTEM), CommandMemory()
    order = {"may_write": False, "number": 0, "latched": "", "after": 0}
    loop = LoopProcess(configuration, memory, commands, order, subprocess.DEVNULL, SYSTEM)
    wait_for(lambda: loop.exit_code is not None, "its end")
    details = [event.get("detail", "") for event in loop.events()]
    loop.close()
    commands.close()
    memory.close()
    assert loop.exit_code == Exit.LINK, details  # nothing listens there


def test_every_file_that_a_cell_names_belongs_to_its_configuration(tmp_path: Path) -> None:
    """Profile, DBC and EDS are read with the cell, whatever the link."""
    path = tmp_path / "cell.yaml"
    text = "robot: {{model: ur10e}}\nlink: {{driver: modbus, profile: ur, host: 127.0.0.1}}\n"
    path.write_text(text.format())
    names = {Path(name).name for name in read_configuration(path).files}
    assert names == {"cell.yaml", "ur.yaml"}
