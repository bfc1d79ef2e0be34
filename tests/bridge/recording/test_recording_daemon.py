"""Recording by the whole daemon: whatever is killed or full, what was measured is there."""

from __future__ import annotations

import json
import os
import resource
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml
from daemon_cell import Robot, Run, gapbridge, only_recording
from patience import wait_for
from recorded_documents import read_documents

from gapbridge.bridge.recording.export import export
from gapbridge.core.log.mcap_reading import read_columns


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    with Robot(tmp_path) as found:
        yield found


def recorder_pid(run: Run) -> int | None:
    return run.daemon.side_processes.status()["recorder"]["pid"]


@pytest.mark.slow
def test_a_recorder_that_is_killed_amidst_a_run_loses_nothing(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        for _ in range(2):
            wait_for(lambda: recorder_pid(run) is not None, "a recorder")
            pid = recorder_pid(run)
            assert pid is not None
            run.cycle(350)
            os.kill(pid, signal.SIGKILL)
            wait_for(lambda dead=pid: recorder_pid(run) != dead, "its end")  # type: ignore[misc]
        run.cycle(250)
        summary = run.end()
    assert summary.exit_code == 0
    assert summary.lost_rows == 0
    assert run.daemon.recording is not None
    numbers = read_columns(run.daemon.recording)["number"]
    assert np.array_equal(numbers, np.arange(len(numbers)))
    assert len(numbers) >= summary.cycles  # a stale clock may be recorded and not count
    assert sum("ended with -9" in line for line in run.output) == 2


@pytest.mark.slow
@pytest.mark.realtime
def test_a_full_disk_pauses_the_recording_and_not_the_run(robot: Robot) -> None:
    with Run(robot.cell(), arm=True) as run:
        run.compensate()
        wait_for(lambda: "recording into" in " ".join(run.output), "a file")
        pid = recorder_pid(run)
        assert pid is not None
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (50_000, before[1]))  # as a full disk refuses
        wait_for(lambda: "recording paused: File too large" in run.output, "a pause")
        run.write(250)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)
        wait_for(lambda: "-002.mcap" in run.output[-1], "another file")
        summary = run.end()
    assert summary.exit_code == 0
    assert summary.restarts == summary.lost_rows == 0
    assert run.daemon.recording is not None
    numbers = read_columns(run.daemon.recording)["number"]
    assert np.array_equal(numbers, np.arange(len(numbers)))  # the ring held what was missing


def test_what_a_disk_that_stays_full_loses_at_the_end_is_counted(robot: Robot) -> None:
    with Run(robot.cell(), arm=False) as run:
        wait_for(lambda: "recording into" in " ".join(run.output), "a file")
        pid = recorder_pid(run)
        assert pid is not None
        before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, before[1]))
        wait_for(lambda: "recording paused: File too large" in run.output, "a pause")
        run.cycle(50)
        summary = run.end()
    assert summary.lost_rows >= 50
    assert f"{summary.lost_rows} cycles could not be recorded" in summary.lines()


@pytest.mark.slow
def test_what_was_recorded_is_diagnosed(robot: Robot) -> None:
    with Run(robot.cell(), arm=True, duration=3.0) as run:
        run.join()
    assert run.daemon.recording is not None
    log = robot.folder / "log.parquet"
    export(run.daemon.recording, log)
    found = robot.folder / "found.json"
    done = gapbridge("diagnose", log, "--cell", robot.folder / "cell.yaml", "--json", found,
                     folder=robot.folder)  # fmt: skip
    out, err = done.communicate(timeout=120)
    assert done.returncode == 0, err
    channels = [channel["channel"] for channel in json.loads(found.read_text())["channels"]]
    assert "tracking" in channels, out


@pytest.mark.slow
def test_the_daemon_runs_on_a_recording_and_makes_the_same_offsets(robot: Robot) -> None:
    with Run(robot.cell(), arm=True, duration=1.5) as run:
        run.join()
    then = run.daemon.recording
    assert then is not None
    given = yaml.safe_load((robot.folder / "cell.yaml").read_text())
    given["link"] = {"driver": "replay", "file": str(then), "speed": 2.0}
    cell = robot.folder / "replay.yaml"
    cell.write_text(yaml.safe_dump(given))
    with Run(cell) as again:
        summary = again.join()
    assert summary.exit_code == 0
    assert any("come to its end" in line for line in again.output)
    assert again.daemon.recording is not None
    found, expected = read_columns(again.daemon.recording), read_columns(then)
    for name in ("offset", "corrected_q", "written", "state", "actual_q"):
        assert found[name].tobytes() == expected[name].tobytes(), name
    assert expected["written"].sum() > 300


def says_it_is_over(session: Path) -> bool:
    """Return whether the recorder has written that the daemon is gone."""
    events = read_documents(session)
    return bool(events) and "gone" in events[-1]["detail"]


def kill_daemons(robot: Robot, times: int) -> None:
    random = np.random.default_rng(7)
    cell = robot.cell()
    log = robot.controller.log
    for k in range(times):
        folder = robot.folder / "recordings"
        before = {path.name.rsplit("-", 1)[0] for path in folder.glob("*.mcap")}
        run = gapbridge("run", cell, "--arm", folder=robot.folder)
        assert run.stdout is not None
        while "-> compensating" not in run.stdout.readline():
            assert run.poll() is None, run.communicate()
        time.sleep(random.uniform(0.0, 2.0))
        killed = time.monotonic()
        run.kill()
        output, _ = run.communicate()
        wait_for(lambda at=k: log().count("rtde_control ended") > at, "the loop's end")  # type: ignore[misc]
        (session,) = {p.name.rsplit("-", 1)[0] for p in folder.glob("*.mcap")} - before
        wait_for(lambda at=folder / session: says_it_is_over(at), "the recording's end")  # type: ignore[misc]
        columns = read_columns(folder / session)
        numbers = columns["number"]
        assert np.array_equal(numbers, np.arange(len(numbers)))
        if "->" not in output:  # a busy machine may have ended the loop before
            assert columns["received"][-1] > killed - 1.0


@pytest.mark.slow
def test_a_daemon_that_is_killed_leaves_a_whole_recording(robot: Robot) -> None:
    kill_daemons(robot, 1)
    assert only_recording(robot.folder / "recordings")


@pytest.mark.slow
def test_daemons_killed_at_random_moments_leave_whole_recordings(robot: Robot) -> None:
    kill_daemons(robot, 6)
