"""Text recordings of other programs, laid out as those programs write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gapbridge.core.errors import LogError
from gapbridge.core.log.sources import SourceOptions, source_of


def franka(path: Path, rows: int = 5) -> np.ndarray:
    """Write what franka::logToCSV writes; return q (rows, 7)."""
    vectors = ("state.q", "state.q_d", "state.dq", "state.dq_d", "state.tau_J",
               "state.tau_ext_hat_filtered", "cmd.q_d")  # fmt: skip
    header = "time, success_rate, " + ",".join(
        ", ".join(f"{name}[{i}]" for i in range(7)) for name in vectors
    )
    q = 0.1 * np.arange(7) + 0.01 * np.arange(rows)[:, None]
    lines = [header]
    for k in range(rows):
        cells = [k, 1.0, *q[k], *(q[k] + 0.001), *np.zeros(14), *(q[k] * 10), *np.zeros(14)]
        lines.append(",".join(f"{cell:g}" for cell in cells))
    path.write_text("\n".join(lines) + "\n")
    return q


def test_a_franka_log_has_seconds_and_both_positions(tmp_path: Path) -> None:
    q = franka(tmp_path / "log.csv")
    found = source_of(tmp_path / "log.csv").read(tmp_path / "log.csv", (), SourceOptions())
    assert np.allclose(found.columns["timestamp"], 0.001 * np.arange(5))
    assert np.allclose(found.columns["actual_q"], q)
    assert np.allclose(found.columns["target_q"], q + 0.001)
    assert np.allclose(found.columns["actual_current_as_torque"], q * 10)


def test_an_rtde_recording_has_spaces(tmp_path: Path) -> None:
    path = tmp_path / "robot.csv"
    joints = [f"{kind}_q_{i}" for kind in ("target", "actual") for i in range(6)]
    names = ["timestamp", *joints, "runtime_state", "payload"]
    values = np.hstack([np.arange(4)[:, None] * 0.002, np.full((4, 12), 0.25),
                        np.full((4, 1), 2), np.full((4, 1), 1.5)])  # fmt: skip
    path.write_text("\n".join([" ".join(names)] + [" ".join(map(str, r)) for r in values]) + "\n")
    found = source_of(path).read(path, (), SourceOptions())
    assert found.columns["actual_q"].shape == (4, 6)
    assert np.allclose(found.columns["payload"], 1.5)
    assert np.allclose(found.columns["timestamp"], 0.002 * np.arange(4))


def test_a_log_is_no_other_source(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("timestamp,actual_q_0\n0,1\n")
    assert source_of(path) is None


def test_text_among_the_numbers_is_one_clear_line(tmp_path: Path) -> None:
    franka(tmp_path / "log.csv")
    with (tmp_path / "log.csv").open("a") as file:
        file.write("5,what" + ",1" * 49 + "\n")
    assert source_of(tmp_path / "log.csv").read(tmp_path / "log.csv", (), SourceOptions())
    with (tmp_path / "log.csv").open("a") as file:
        file.write("6,1,what" + ",1" * 48 + "\n")
    with pytest.raises(LogError, match=r"log.csv: row 8, column actual_q_0: found 'what', expect"):
        source_of(tmp_path / "log.csv").read(tmp_path / "log.csv", (), SourceOptions())


def test_a_header_alone_is_refused(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    franka(tmp_path / "log.csv", rows=0)
    with pytest.raises(LogError, match=r"log\.csv: found no rows below the header"):
        source_of(tmp_path / "log.csv").read(tmp_path / "log.csv", (), SourceOptions())
    assert not recwarn.list


@pytest.mark.parametrize(
    ("extra", "found"),
    [
        ("payload_cog_0 payload_cog_1", "column payload_cog_2: not found"),
        ("actual_TCP_force_0", "column actual_TCP_force_1: not found"),
        ("target_q_0 target_q_1", "column target_q_2: not found"),
        ("joint_temperatures_6", "column joint_temperatures_0: not found"),
        ("actual_q_5", "column actual_q_5: found twice"),
    ],
)
def test_a_vector_that_is_not_whole_is_refused(tmp_path: Path, extra: str, found: str) -> None:
    path = tmp_path / "robot.txt"
    names = [*(f"actual_q_{i}" for i in range(6)), *extra.split()]
    path.write_text(" ".join(names) + "\n" + " ".join(["0.5"] * len(names)) + "\n")
    with pytest.raises(LogError, match=rf"robot\.txt: {found}"):
        source_of(path).read(path, (), SourceOptions())


def test_a_franka_log_has_to_have_its_times(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text("state.q[0],state.q[1]\n0.1,0.2\n")
    with pytest.raises(LogError, match=r"log\.csv: column time: not found, expected it \(ms\)"):
        source_of(path).read(path, (), SourceOptions())


def test_an_empty_cell_between_tabs_is_a_missing_reading(tmp_path: Path) -> None:
    """Not the next column's value: the three positions of a lost target were joints' angles."""
    path = tmp_path / "robot.txt"
    names = ["timestamp", "robot mode", *(f"measured_position_{i}" for i in range(3)),
             *(f"actual_q_{i}" for i in range(6)), "a", "b", "c"]  # fmt: skip
    cells = ["0", "7", *"123", *(f"0,{i}" for i in range(1, 7)), *"777"]
    lost = [*cells[:2], "", "", "", *cells[5:]]
    path.write_text("\n".join("\t".join(row) for row in (names, cells, lost, cells)) + "\n")
    found = source_of(path).read(path, (), SourceOptions()).columns
    assert np.allclose(found["actual_q"], [[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]] * 3)
    assert np.isnan(found["measured_position"][1]).all()
    assert np.isfinite(found["measured_position"][[0, 2]]).all()


def test_a_row_with_another_number_of_cells_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.txt"
    names = ["timestamp", "note", *(f"actual_q_{i}" for i in range(6))]
    row = "0 7 0.1 0.2 0.3 0.4 0.5 0.6"
    path.write_text("\n".join([" ".join(names), row, "", row + " 0.7"]) + "\n")
    with pytest.raises(LogError, match=r"robot\.txt: row 4: found 9 cells, expected 8"):
        source_of(path).read(path, (), SourceOptions())


def test_decimal_commas_between_commas_are_refused(tmp_path: Path) -> None:
    franka(tmp_path / "log.csv", rows=1)
    header, row = (tmp_path / "log.csv").read_text().splitlines()
    (tmp_path / "log.csv").write_text(header + "\n" + row.replace(".", ",") + "\n")
    with pytest.raises(LogError, match=r"log\.csv: row 2: found \d+ cells, expected 51"):
        source_of(tmp_path / "log.csv").read(tmp_path / "log.csv", (), SourceOptions())
