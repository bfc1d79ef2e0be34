"""Reading logs: what is taken as it stands, and every mistake in one line."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from core.errors import LogError
from core.log import last_motion, read_log

RECORDING = Path(__file__).parents[3] / "shared" / "data" / "rad_ur3e_rtde" / "log.csv"
HEAD = "timestamp,actual_q_0,actual_q_1,payload"


def write(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_columns_come_as_arrays_by_name(tmp_path):
    path = write(tmp_path, f"{HEAD},note\n0,1,2,0.5,hello\n0.1,3,4,1.5,\n")
    log = read_log(path, 2)
    assert len(log) == 2
    assert log.path == str(path)
    np.testing.assert_array_equal(log.get("actual_q"), [[1, 2], [3, 4]])
    np.testing.assert_array_equal(log.get("payload"), [0.5, 1.5])
    assert not log.has("note")
    assert log.get("target_q") is None


def test_the_order_of_columns_is_free(tmp_path):
    log = read_log(write(tmp_path, "actual_q_1,payload,actual_q_0\n2,9,1\n"), 2)
    np.testing.assert_array_equal(log.get("actual_q"), [[1, 2]])


@pytest.mark.parametrize(
    "text",
    [
        f"{HEAD}\n0,1,2,0.5\n".replace(",", ";"),
        f"\ufeff{HEAD}\n0,1,2,0.5\n",
        f"{HEAD}\r\n0,1,2,0.5\r\n",
        f"{HEAD}\n0,1,2,0.5\n\n  \n",
        '"timestamp","actual_q_0","actual_q_1","payload"\n0,"1","2",0.5\n',
        " timestamp , actual_q_0, actual_q_1, payload\n 0, 1, 2, 0.5\n",
    ],
    ids=["semicolons", "byte order mark", "crlf", "blank lines at the end", "quotes", "blanks"],
)
def test_usual_ways_of_writing_csv_are_read(tmp_path, text):
    log = read_log(write(tmp_path, text), 2)
    np.testing.assert_array_equal(log.get("actual_q"), [[1, 2]])
    np.testing.assert_array_equal(log.get("payload"), [0.5])


def test_an_empty_cell_is_nothing_and_only_told_where_it_is_needed(tmp_path):
    log = read_log(write(tmp_path, f"{HEAD}\n0,1,,0.5\n1,1,2,0.5\n"), 2)
    assert np.isnan(log.get("actual_q")[0, 1])
    with pytest.raises(LogError, match=r"row 2, column actual_q_1: found nan, expected a finite"):
        log.require("actual_q")


def table(rows=3, n=2):
    columns = {f"actual_q_{i}": np.arange(rows) + 10.0 * i for i in range(n)}
    return {"timestamp": np.arange(rows, dtype=float), **columns, "note": ["x"] * rows}


def test_parquet_is_read_as_csv_is(tmp_path):
    path = tmp_path / "log.parquet"
    parquet.write_table(pa.table({**table(), "payload": pa.array([1, 2, 3], pa.int32())}), path)
    log = read_log(path, 2)
    np.testing.assert_array_equal(log.get("actual_q"), [[0, 10], [1, 11], [2, 12]])
    np.testing.assert_array_equal(log.get("payload"), [1, 2, 3])
    assert not log.has("note")


def test_a_null_in_parquet_is_an_empty_cell(tmp_path):
    path = tmp_path / "log.pq"
    parquet.write_table(pa.table({"payload": pa.array([1.0, None])}), path)
    log = read_log(path, 2)
    with pytest.raises(LogError, match="row 3, column payload: found nan"):
        log.require("payload")


def test_broken_parquet_is_told(tmp_path):
    with pytest.raises(LogError, match="found no readable Parquet file"):
        read_log(write(tmp_path, "nothing", "log.parquet"), 2)
    path = tmp_path / "text.parquet"
    parquet.write_table(pa.table({"payload": ["a", "b"]}), path)
    with pytest.raises(LogError, match="column payload: found text, expected numbers"):
        read_log(path, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "found an empty file, expected a CSV header"),
        ("\n\n", "found an empty file"),
        (f"{HEAD}\n", "found no data rows, expected at least one"),
        (f"{HEAD}\n0,1,2,0.5\n0,1,2\n", "row 3: found 3 cells, expected 4 as in the header"),
        (f"{HEAD}\n0,1,2,0.5,9\n", "row 2: found 5 cells, expected 4"),
        (f"{HEAD}\n0,1,2,0.5\n0,one,2,3\n",
         "row 3, column actual_q_0: found 'one', expected a number"),
        (f"{HEAD},actual_q_2\n0,1,2,3,4\n",
         "column actual_q_2: found one too many, expected 2 columns actual_q_0..1 of a 2-joint"),
        ("actual_q_0,payload\n1,2\n",
         "column actual_q_1: not found, expected 2 columns actual_q_0..1"),
        ("target_q_0,target_q_2\n1,2\n", "column target_q_1: not found"),
        ("actual_TCP_force_0,actual_TCP_force_1\n1,2\n",
         "column actual_TCP_force_2: not found, expected 6 columns actual_TCP_force_0..5"),
        ("measured_position_0,measured_position_1,measured_position_2,measured_position_3\n1,2,3,4\n",
         "column measured_position_3: found one too many, expected 3 columns"),
        ("payload,payload\n1,2\n", "column payload: found twice, expected once"),
        ("actual_q_0,actual_q_1,actual_q_1\n1,2,3\n", "column actual_q_1: found twice"),
        ("actual_p_0,actual_p_1\n1,2\n", "found 'actual_p_0', did you mean 'actual_q'?"),
        ("x,y\n1,2\n", "found none that the contract names (x, y), expected RTDE field names"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_in_one_line(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(LogError) as caught:
        read_log(path, 2)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_bytes_are_told(tmp_path):
    with pytest.raises(LogError, match="file not found, expected a CSV or Parquet log"):
        read_log(tmp_path / "none.csv", 2)
    path = tmp_path / "bytes.csv"
    path.write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(LogError, match="found bytes that are no text"):
        read_log(path, 2)


def test_what_a_command_needs_is_asked_for_by_its_columns(tmp_path):
    log = read_log(write(tmp_path, f"{HEAD}\n0,1,2,0.5\n"), 2)
    np.testing.assert_array_equal(log.require("target_q", "actual_q"), [[1, 2]])
    with pytest.raises(LogError, match=r"found no measured_position_0..2, expected it"):
        log.require("measured_position")
    with pytest.raises(LogError, match=r"found no target_q_0..1 or actual_qd_0..1"):
        log.require("target_q", "actual_qd")


def test_infinities_are_no_numbers_to_work_with(tmp_path):
    log = read_log(write(tmp_path, f"{HEAD}\n0,1,2,inf\n"), 2)
    with pytest.raises(LogError, match="row 2, column payload: found inf"):
        log.loads()


def test_a_payload_below_zero_is_told(tmp_path):
    log = read_log(write(tmp_path, f"{HEAD}\n0,1,2,1\n0,1,2,-0.5\n"), 2)
    with pytest.raises(LogError, match=r"row 3, column payload: found -0.5, expected 0 or more kg"):
        log.loads()


def test_loads_are_what_acts_on_the_arm(tmp_path):
    names = [*(f"actual_TCP_force_{k}" for k in range(6)), "joint_temperatures_0",
             "joint_temperatures_1", *(f"payload_cog_{k}" for k in range(3))]  # fmt: skip
    loads = read_log(write(tmp_path, ",".join(names) + "\n" + ",".join("123456789ab"[:9]) +
                           ",10,11\n"), 2).loads()  # fmt: skip
    np.testing.assert_array_equal(loads.wrench, [[1, 2, 3, 4, 5, 6]])
    np.testing.assert_array_equal(loads.temperature, [[7, 8]])
    np.testing.assert_array_equal(loads.payload_cog, [[9, 10, 11]])
    assert loads.payload_mass is None


def test_the_last_motion_is_carried_on_where_a_joint_stands():
    q = np.array([[0.0, 0], [1, 0], [1, -1], [0, -1], [0, -1]])
    np.testing.assert_array_equal(last_motion(q), [[0, 0], [1, 0], [1, -1], [-1, -1], [-1, -1]])


def test_approach_columns_stand_before_what_the_angles_say(tmp_path):
    text = "actual_q_0,actual_q_1,approach_0,approach_1\n0,0,-1,1\n1,1,-1,0\n"
    log = read_log(write(tmp_path, text), 2)
    np.testing.assert_array_equal(log.loads().approach, [[-1, 1], [-1, 0]])


def test_without_angles_there_is_no_approach(tmp_path):
    assert read_log(write(tmp_path, "payload\n1\n"), 2).approach() is None


def test_rows_can_be_selected(tmp_path):
    log = read_log(write(tmp_path, f"{HEAD}\n0,1,2,3\n1,5,6,7\n"), 2).select(np.array([1]))
    assert len(log) == 1
    np.testing.assert_array_equal(log.get("actual_q"), [[5, 6]])


@pytest.mark.skipif(not RECORDING.is_file(), reason="the measured data sets are not beside us")
def test_a_robots_own_recording_is_a_log_as_it_stands():
    log = read_log(RECORDING, 6)
    assert len(log) == 888
    for name in ("target_q", "actual_q", "actual_qd", "joint_temperatures", "actual_TCP_force"):
        assert log.require(name).shape == (888, 6)
    assert log.require("payload")[0] == pytest.approx(1.07)
    assert log.require("actual_q")[0, 0] == pytest.approx(-4.3719462)
    assert log.loads().payload_cog.shape == (888, 3)
