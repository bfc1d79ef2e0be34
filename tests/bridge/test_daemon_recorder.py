from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from daemon_cell import read_cycles
from numpy.typing import NDArray

from bridge.cycle_row import fill_row
from bridge.recorder import Recorder
from bridge.settings import RecordingSettings
from bridge.shared_page import slices_of
from bridge.supervisor import State
from core.errors import InputError
from core.log import read_log
from core.state import RobotState

N = 6


def row(k: int, **fields: object) -> NDArray[np.float64]:
    s = slices_of(N)
    found = np.zeros(s["loop"].stop)
    q = np.arange(N) + 0.001 * k
    given: dict[str, object] = {
        "timestamp": 0.002 * k, "received": 0.0, "actual_q": q, "actual_qd": np.zeros(N),
        "target_q": q, "actual_TCP_force": np.arange(6.0),
    }  # fmt: skip
    state = RobotState(**{**given, **fields})  # type: ignore[arg-type]
    fill_row(found, s, state, q, q + 1e-3, np.full(6, 2e-3))
    found[2] = State.OBSERVING
    return found


def record(folder: Path, batches: list[NDArray[np.float64]], every: int = 1) -> Path:
    with Recorder(RecordingSettings(folder=folder, every=every), N) as recorder:
        for batch in batches:
            recorder.write(batch)
    assert recorder.path is not None
    return recorder.path


def test_a_recording_reads_as_a_log_with_what_was_computed_beside(tmp_path: Path) -> None:
    path = record(tmp_path, [np.array([row(0), row(1)]), np.array([row(2)])])
    log = read_log(path, N)
    assert log.require("timestamp") == pytest.approx([0.0, 0.002, 0.004])
    assert log.require("actual_q")[2] == pytest.approx(np.arange(N) + 0.002)
    assert log.require("actual_TCP_force")[0] == pytest.approx(np.arange(6.0))
    cycles = read_cycles(path)
    assert cycles["corrected_q_3"][0] == pytest.approx(3.001)
    assert cycles["offset_5"] == pytest.approx([2e-3] * 3)
    assert cycles["state"] == ["observing"] * 3


def test_channels_that_the_controller_lacks_are_left_out(tmp_path: Path) -> None:
    header = record(tmp_path / "a", [np.array([row(0)])]).read_text().splitlines()[0]
    for name in ("ft_raw_wrench", "joint_temperatures", "actual_current_as_torque", "payload"):
        assert name not in header
    full = row(0, payload=2.0, payload_cog=np.ones(3), ft_raw_wrench=np.ones(6))
    header = record(tmp_path / "b", [np.array([full])]).read_text().splitlines()[0]
    assert re.search(r"payload_cog_2.*ft_raw_wrench_5.*payload,", header)


def test_every_so_manieth_cycle_is_counted_across_batches(tmp_path: Path) -> None:
    batches = [np.array([row(k) for k in part]) for part in ([0, 1], [2], [3, 4, 5, 6, 7])]
    path = record(tmp_path, batches, every=3)
    assert read_cycles(path)["timestamp"] == pytest.approx([0.0, 0.006, 0.012])


def test_a_second_run_in_the_same_second_has_a_file_of_its_own(tmp_path: Path) -> None:
    assert record(tmp_path, [np.array([row(0)])]) != record(tmp_path, [np.array([row(1)])])


def test_a_folder_that_cannot_be_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match=r"recording\.folder: .*taken"):
        Recorder(RecordingSettings(folder=tmp_path / "taken"), N)


def test_without_a_folder_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with Recorder(RecordingSettings(folder=None), N) as recorder:
        recorder.write(np.array([row(0)]))
        recorder.tell({"to": "observing"})
    assert recorder.path is None
    assert list(tmp_path.iterdir()) == []


def test_rows_and_events_are_there_before_the_recorder_is_closed(tmp_path: Path) -> None:
    recorder = Recorder(RecordingSettings(folder=tmp_path), N)
    recorder.write(np.array([row(k) for k in range(40)]))
    recorder.tell({"to": "OBSERVING"})
    assert recorder.path is not None
    assert len(recorder.path.read_text().splitlines()) == 41
    events = recorder.path.with_suffix(".events.jsonl").read_text().splitlines()
    assert json.loads(events[0])["to"] == "OBSERVING"
    recorder.close()


def test_a_full_disk_ends_the_recording_and_not_the_run(tmp_path: Path) -> None:
    recorder = Recorder(RecordingSettings(folder=tmp_path), N)
    assert recorder._csv is not None
    recorder._csv.close()
    recorder._csv = open("/dev/full", "w", encoding="utf-8")  # noqa: SIM115
    recorder.write(np.array([row(k) for k in range(200)]))
    recorder.write(np.array([row(200)]))
    assert recorder.path is not None
    events = recorder.path.with_suffix(".events.jsonl").read_text()
    assert "No space left" in events
    recorder._csv = None
    recorder.close()
