"""``gapbridge convert``, and commands that take a source where they take a log."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np
import pytest
from cli_runs import gapbridge
from pyarrow import parquet

CELL = """
robot: {model: ur5e}
metrology: {registered: true, sigma: 2.0e-5}
"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Return an RTDE recording with spaces between its columns, and a cell beside it."""
    (tmp_path / "cell.yaml").write_text(CELL)
    rng = np.random.default_rng(4)
    q = rng.uniform(-1, 1, (8, 6))
    names = ["timestamp", *(f"actual_q_{i}" for i in range(6)), "robot_mode"]
    rows = np.hstack([np.arange(8)[:, None] * 0.1, q, np.full((8, 1), 7)])
    text = "\n".join([" ".join(names), *(" ".join(f"{v:.17g}" for v in row) for row in rows)])
    (tmp_path / "robot.csv").write_text(text + "\n")
    (tmp_path / "plain.csv").write_text(text.replace(" ", ",") + "\n")
    return tmp_path / "robot.csv"


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_a_recording_becomes_a_log(recording: Path, suffix: str) -> None:
    out = recording.with_name(f"log{suffix}")
    done = gapbridge("convert", recording, "--cell", recording.with_name("cell.yaml"), "--out", out)
    assert done.code == 0, done.err
    assert "8 rows" in done.out
    if suffix == ".csv":
        assert out.read_text().startswith("timestamp,actual_q_0,")
    else:
        assert parquet.read_table(out).num_rows == 8


def test_predict_takes_the_source_itself(recording: Path) -> None:
    cell, folder = recording.with_name("cell.yaml"), recording.parent
    gapbridge("convert", recording, "--cell", cell, "--out", folder / "log.csv")
    for given, out in ((recording, "a.csv"), (folder / "log.csv", "b.csv")):
        done = gapbridge("predict", given, "--cell", cell, "--out", folder / out)
        assert done.code == 0, done.err
    assert (folder / "a.csv").read_text() == (folder / "b.csv").read_text()


def test_predictions_under_a_parquet_name_are_parquet(recording: Path) -> None:
    out = recording.with_name("predicted.parquet")
    done = gapbridge("predict", recording, "--cell", recording.with_name("cell.yaml"),
                     "--out", out)  # fmt: skip
    assert done.code == 0, done.err
    assert parquet.read_table(out).column_names[0] == "predicted_position_0"


@pytest.mark.parametrize(
    ("arguments", "output"),
    [
        (["nowhere.bag", "--out", "log.csv"], "nowhere.bag: not found"),
        (["cell.yaml", "--out", "log.csv"], "found no known kind of recording"),
        (["bags", "--out", "log.csv"], "give the bag's file itself, run_0.db3"),
        (["plain.csv", "--out", "log.csv"], "actual_q_0 is a log as it stands"),
        (["robot.csv", "--out", "log.txt"], "expected .csv or .parquet"),
        (["robot.csv", "--out", "log.csv", "--topic", "joint=x"], "--topic: found 'joint=x'"),
        (["robot.csv", "--out", "log.csv", "--topic", "joints=/x"], "--topic: found with a record"),
        (["robot.csv", "--out", "log.csv", "--joints", "a,b"], "expected none of the kind"),
        (["robot.csv", "--out", "log.csv", "--episode", "0"], "--episode: found with a recording"),
        (["robot.csv", "--out", "log.csv", "--effort-is-torque"], "--effort-is-torque: found with"),
        (
            ["data", "--out", "log.csv", "--wrench", "ft_raw_wrench"],
            "expected one of --joints, --calibration, --units, --episode",
        ),
        (["robot.csv", "--out", "robot.csv"], "found the output to be the input"),
    ],
)
def test_what_cannot_be_converted_is_one_line(
    recording: Path, arguments: list[str], output: str
) -> None:
    dataset = recording.parent / "data" / "meta" / "info.json"
    dataset.parent.mkdir(parents=True)
    dataset.write_text("{}")
    (recording.parent / "bags").mkdir()
    (recording.parent / "bags" / "run_0.db3").touch()
    with contextlib.chdir(recording.parent):
        done = gapbridge("convert", *arguments)
    assert done.code == 2
    assert output in done.err
    assert len(done.err.strip().splitlines()) == 1
