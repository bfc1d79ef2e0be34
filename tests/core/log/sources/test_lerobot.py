"""LeRobot datasets as their writer lays them out: v3 files, names with ``.pos``, own units."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from gapbridge.bridge.document.notes import note_texts
from gapbridge.core.errors import LogError
from gapbridge.core.log.sources import SourceOptions, source_of

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
NAMES = ("gripper", *JOINTS[::-1])  # another order than the arm's
FRAMES = 30
RANGE = {name: (1000 + 100 * i, 3047 + 100 * i) for i, name in enumerate((*JOINTS, "gripper"))}


def numbers(episode: int) -> dict[str, np.ndarray]:
    """Return each joint's numbers (frames,), each its own."""
    steps = np.arange(FRAMES)
    return {name: 5.0 * i + steps + 40 * episode for i, name in enumerate(NAMES)}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    folder = tmp_path / "set"
    (folder / "meta").mkdir(parents=True)
    (folder / "data" / "chunk-000").mkdir(parents=True)
    names = [f"{name}.pos" for name in NAMES]
    features = {key: {"dtype": "float32", "shape": [6], "names": names}
                for key in ("action", "observation.state")}  # fmt: skip
    info = {"codebase_version": "v3.0", "fps": 30, "features": features}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    rows: dict[str, list] = {"action": [], "observation.state": [], "timestamp": [],
                             "episode_index": [], "frame_index": []}  # fmt: skip
    for episode in (0, 1):
        found = numbers(episode)
        for k in range(FRAMES):
            state = [float(found[name][k]) for name in NAMES]
            rows["observation.state"].append(state)
            rows["action"].append([value + 0.5 for value in state])
            rows["timestamp"].append(k / 30)
            rows["episode_index"].append(episode)
            rows["frame_index"].append(k)
    parquet.write_table(pyarrow.table(rows), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    file = tmp_path / "arm.json"
    file.write_text(json.dumps({
        name: {"id": i + 1, "drive_mode": 0, "homing_offset": 7, "range_min": low,
               "range_max": high}
        for i, (name, (low, high)) in enumerate(RANGE.items())
    }))  # fmt: skip
    return file


def test_joints_are_found_by_name_and_scaled_by_the_calibration(
    dataset: Path, calibration: Path
) -> None:
    found = source_of(dataset).read(dataset, JOINTS, SourceOptions(calibration=calibration))
    # from -100 to 100 over 2047 of 4095 steps a turn
    rad = 2047 / 200 * 2 * np.pi / 4095
    state = np.column_stack([numbers(0)[name] for name in JOINTS])
    assert np.allclose(found.columns["actual_q"][:FRAMES], state * rad)
    assert np.allclose(found.columns["target_q"][:FRAMES], (state + 0.5) * rad)
    assert any("latency below 33 ms" in note for note in note_texts(found.notes))


def test_episodes_follow_one_another_in_time(dataset: Path) -> None:
    found = source_of(dataset).read(dataset, JOINTS, SourceOptions(units="degrees"))
    steps = np.diff(found.columns["timestamp"])
    assert len(found) == 2 * FRAMES
    assert np.allclose(np.delete(steps, FRAMES - 1), 1 / 30)
    assert steps[FRAMES - 1] == pytest.approx(1.0)


def test_one_episode_can_be_taken(dataset: Path) -> None:
    options = SourceOptions(units="rad", episode=1)
    found = source_of(dataset).read(dataset, JOINTS, options)
    assert np.allclose(found.columns["actual_q"][:, 0], numbers(1)[JOINTS[0]])
    with pytest.raises(LogError, match="no episode 7, expected 0 to 1"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad", episode=7))


def test_units_that_nobody_states_are_asked_for(dataset: Path) -> None:
    with pytest.raises(LogError, match=r"--calibration FILE.*--units"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions())


def test_a_calibration_of_another_arm_is_refused(dataset: Path, tmp_path: Path) -> None:
    file = tmp_path / "other.json"
    file.write_text(json.dumps({"joint_1": {"range_min": 0, "range_max": 4095}}))
    with pytest.raises(LogError, match=r"other.json: shoulder_pan: not found"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(calibration=file))


def test_a_dataset_without_names_is_refused(dataset: Path) -> None:
    info = dataset / "meta" / "info.json"
    given = json.loads(info.read_text())
    given["features"]["action"]["names"] = None
    info.write_text(json.dumps(given))
    with pytest.raises(LogError, match=r"features.action.names: found None"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad"))


@pytest.mark.parametrize(
    ("least", "most"), [(0, 0), (3000, 1000), (float("nan"), 3000), (1000, float("inf"))]
)
def test_a_calibration_without_a_range_is_refused(
    dataset: Path, calibration: Path, least: float, most: float
) -> None:
    """All angles would be zero, or turned round."""
    given = json.loads(calibration.read_text())
    given["elbow_flex"] |= {"range_min": least, "range_max": most}
    calibration.write_text(json.dumps(given))
    with pytest.raises(LogError, match=r"arm\.json: elbow_flex: found range_min"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(calibration=calibration))


def test_contradicting_options_are_refused(dataset: Path, calibration: Path) -> None:
    both = SourceOptions(units="rad", calibration=calibration)
    with pytest.raises(LogError, match="--units: found with --calibration"):
        source_of(dataset).read(dataset, JOINTS, both)
    twice = SourceOptions(("elbow_flex",) * 5, units="rad")
    with pytest.raises(LogError, match="--joints: found elbow_flex twice"):
        source_of(dataset).read(dataset, JOINTS, twice)


def test_frames_and_rates_that_are_no_numbers_are_refused(dataset: Path) -> None:
    file = dataset / "data" / "chunk-000" / "file-000.parquet"
    whole = parquet.read_table(file)
    for name, values, phrase in (
        ("action", [[1.0, 2.0]] * (2 * FRAMES), "column action: expected 6 numbers in each of 60"),
        ("action", ["x"] * (2 * FRAMES), "column action: expected 6 numbers"),
        ("action", [[1.0]] + [[1.0, 2.0]] * (2 * FRAMES - 1), "column action: expected 6 numbers"),
        ("timestamp", [None] * (2 * FRAMES), "column timestamp: expected a number in each of 60"),
    ):
        changed = whole.set_column(whole.column_names.index(name), name, pyarrow.array(values))
        parquet.write_table(changed, file)
        with pytest.raises(LogError, match=phrase):
            source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad"))
    parquet.write_table(whole, file)
    info = dataset / "meta" / "info.json"
    for fps, found in (("x", "'x'"), (float("nan"), "nan"), (float("inf"), "inf"), (-30, "-30"),
                       (10**400, "10+")):  # fmt: skip
        info.write_text(json.dumps(json.loads(info.read_text()) | {"fps": fps}))
        with pytest.raises(LogError, match=f"fps: found {found}.*, expected a number above 0"):
            source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad"))


def with_actions(dataset: Path, row: int, value: float | None) -> None:
    """Replace the numbers of one frame's action."""
    file = dataset / "data" / "chunk-000" / "file-000.parquet"
    whole = parquet.read_table(file)
    actions = whole["action"].to_pylist()
    actions[row] = [value] * len(NAMES)
    position = whole.column_names.index("action")
    parquet.write_table(whole.set_column(position, "action", pyarrow.array(actions)), file)


def test_infinite_numbers_are_refused_and_missing_ones_noted(dataset: Path) -> None:
    options = SourceOptions(units="rad")
    with_actions(dataset, 5, None)
    with_actions(dataset, 40, float("nan"))
    found = source_of(dataset).read(dataset, JOINTS, options)
    assert np.flatnonzero(np.isnan(found.columns["target_q"]).any(axis=1)).tolist() == [5, 40]
    assert "2 rows without a value of target_q" in note_texts(found.notes)
    with_actions(dataset, 6, -np.inf)
    with pytest.raises(LogError, match="row 7, column action: found inf, expected finite"):
        source_of(dataset).read(dataset, JOINTS, options)


def test_a_chunk_without_frames_is_left_out(dataset: Path) -> None:
    """So is an episode that is being recorded."""
    whole = parquet.read_table(dataset / "data" / "chunk-000" / "file-000.parquet")
    parquet.write_table(whole[:0], dataset / "data" / "chunk-000" / "file-001.parquet")
    found = source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad", episode=1))
    assert len(found.columns["timestamp"]) == FRAMES
    with pytest.raises(LogError, match="found no episode 7, expected 0 to 1"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad", episode=7))
    parquet.write_table(whole[:0], dataset / "data" / "chunk-000" / "file-000.parquet")
    with pytest.raises(LogError, match="data: found no frames, expected at least one"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad"))


def test_json_that_python_cannot_take_is_refused(dataset: Path, tmp_path: Path) -> None:
    deep = "[" * 200_000 + "]" * 200_000
    (tmp_path / "deep.json").write_text(deep)
    options = SourceOptions(calibration=tmp_path / "deep.json")
    with pytest.raises(LogError, match=r"deep\.json: found no LeRobot calibration"):
        source_of(dataset).read(dataset, JOINTS, options)
    huge = {name: {"range_min": 0, "range_max": 10**400} for name in RANGE}
    (tmp_path / "deep.json").write_text(json.dumps(huge))
    with pytest.raises(LogError, match=r"deep\.json: found no LeRobot calibration"):
        source_of(dataset).read(dataset, JOINTS, options)
    (dataset / "meta" / "info.json").write_text(deep)
    with pytest.raises(LogError, match=r"info\.json: found no readable JSON"):
        source_of(dataset).read(dataset, JOINTS, SourceOptions(units="rad"))
