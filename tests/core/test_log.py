"""Logs: recordings as they come, and one line for every way in which a file can be wrong."""

import bz2
import gzip
import lzma
import os
from pathlib import Path

import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.log_checks.units_and_clocks import check_units
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import last_motion, read_log
from gapbridge.core.log.pieces import LogPieces
from gapbridge.core.log.sources import SourceOptions, source_of
from gapbridge.core.model import Model

RECORDING = Path(__file__).parents[2] / ".." / "shared" / "data" / "rad_ur3e_rtde" / "log.csv"
JOINTS = [f"actual_q_{i}" for i in range(6)]


def write(tmp_path, text, name="log.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def table(columns, rows, delimiter=","):
    lines = [delimiter.join(columns)]
    return "\n".join(lines + [delimiter.join(str(v) for v in row) for row in rows]) + "\n"


def joints(rows=3, start=0.0):
    return [[start + r + i / 10 for i in range(6)] for r in range(rows)]


def test_what_is_written_is_read(tmp_path):
    log = read_log(write(tmp_path, table(["timestamp", *JOINTS], [[0, *r] for r in joints()])), 6)
    np.testing.assert_allclose(log.require("actual_q"), joints())
    np.testing.assert_array_equal(log.get("timestamp"), 0)
    assert len(log) == 3
    assert not log.has("target_q")
    assert log.get("target_q") is None


@pytest.mark.parametrize(("zeros", "missing"), [((1, 4), [1, 4]), ((0,), [])])
def test_positions_of_three_zeros_are_missing_readings(tmp_path, zeros, missing):
    """A fifth of such rows were links 4 mm off, with certainty; one may be the frame's origin."""
    position = np.arange(18.0).reshape(6, 3) + 1
    position[5, 1:] = 0.0
    position[list(zeros)] = 0.0
    rows = np.hstack([joints(6), position]).tolist()
    names = [*JOINTS, *(f"measured_position_{k}" for k in range(3))]
    log = read_log(write(tmp_path, table(names, rows)), 6)
    found = np.isnan(log.columns["measured_position"])
    np.testing.assert_array_equal(np.flatnonzero(found.any(axis=1)), missing)
    np.testing.assert_array_equal(found.any(axis=1), found.all(axis=1))


@pytest.mark.parametrize("delimiter", [",", ";"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_semicolons_line_ends_marks_and_blank_ends_do_not_matter(tmp_path, delimiter, end, mark):
    text = mark + table(JOINTS, joints(), delimiter).replace("\n", end) + end + end
    path = tmp_path / "log.csv"
    path.write_bytes(text.encode())
    np.testing.assert_allclose(read_log(path, 6).require("actual_q"), joints())


def test_blanks_in_the_header_and_blank_lines_before_it_do_not_matter(tmp_path):
    text = table(JOINTS, joints())
    path = write(tmp_path, "\n \n" + text.replace(",actual", " , actual"))
    for log in (read_log(path, 6), *LogPieces(path, 6)):
        np.testing.assert_allclose(log.require("actual_q"), joints())
        assert log.line(0) == 4
    assert source_of(path) is None  # no recording of UR's, which has blanks alone


def test_decimal_commas_comments_and_gzip_are_read(tmp_path):
    rows = [[str(v).replace(".", ",") for v in r] for r in joints()]
    lines = table(JOINTS, rows, ";").splitlines()
    text = "\n".join(["# of the cell", *lines[:2], "  # a pause; of two, lines", *lines[2:]]) + "\n"
    plain, packed = write(tmp_path, text), tmp_path / "log.csv.gz"
    packed.write_bytes(gzip.compress(text.encode()))
    for path in (plain, packed):
        log = read_log(path, 6)
        np.testing.assert_allclose(log.require("actual_q"), joints())
        assert [log.line(row) for row in range(3)] == [3, 5, 6]
        np.testing.assert_array_equal(log.times(), [1, 2, 3])
    (piece,) = LogPieces(plain, 6)
    np.testing.assert_allclose(piece.require("actual_q"), joints())
    with pytest.raises(LogError, match="gunzip"):
        list(LogPieces(packed, 6))
    packed.write_bytes(packed.read_bytes()[:40])
    with pytest.raises(LogError, match="no readable file"):
        read_log(packed, 6)


def test_utf_16_as_excel_writes_it_is_read(tmp_path):
    text = "actual_q_0,actual_q_1,payload_mass\n0.5,-0.25,1.5\n0.1,0.2,3\n"
    for encoding in ("utf-16", "utf-16-le", "utf-16-be"):
        path = tmp_path / f"{encoding}.csv"
        mark = {"utf-16-le": b"\xff\xfe", "utf-16-be": b"\xfe\xff"}.get(encoding, b"")
        path.write_bytes(mark + text.encode(encoding))
        for log in (read_log(path, 2), *LogPieces(path, 2)):
            assert log.require("actual_q").tolist() == [[0.5, -0.25], [0.1, 0.2]]


@pytest.mark.parametrize(
    ("packed", "cure"),
    [
        (lzma.compress(b"actual_q_0\n1\n"), "packed by xz: unpack it"),
        (bz2.compress(b"actual_q_0\n1\n"), "packed by bzip2: unpack it"),
        (b"\x28\xb5\x2f\xfd" + bytes(20), "packed by Zstandard: unpack it"),
        (b"PK\x03\x04" + bytes(20), "an Excel workbook or a zip archive: save the sheet as CSV"),
        (b"PAR1" + bytes(20), "a Parquet file: give it a name that ends in .parquet"),
    ],
)
def test_what_is_packed_is_refused_with_the_cure(tmp_path, packed, cure):
    path = tmp_path / "log.csv"
    path.write_bytes(packed)
    with pytest.raises(LogError, match=cure):
        read_log(path, 1)
    with pytest.raises(LogError, match=cure):
        next(iter(LogPieces(path, 1)))


def test_decimal_commas_between_commas_are_refused_with_the_cure(tmp_path):
    rows = [[str(v).replace(".", ",") for v in r] for r in joints()]
    path = write(tmp_path, table(JOINTS, rows, ","))
    for read in (lambda: read_log(path, 6), lambda: list(LogPieces(path, 6))):
        with pytest.raises(LogError, match=r"decimal commas.*then ; between"):
            read()


def test_decimal_commas_between_tabs_are_read(tmp_path):
    rows = [[f"{v:.3f}".replace(".", ",") for v in r] for r in joints()]
    path = write(tmp_path, table(JOINTS, rows, "\t"))
    source = source_of(path)
    found = source.read(path, JOINTS, SourceOptions()).columns["actual_q"]
    np.testing.assert_allclose(found, joints(), atol=1e-3)


def test_columns_may_stand_in_any_order_and_unknown_ones_are_ignored(tmp_path):
    rows = [["noise", *reversed(r), "x y"] for r in joints()]
    path = write(tmp_path, table(["operator", *reversed(JOINTS), "remark"], rows))
    log = read_log(path, 6)
    np.testing.assert_allclose(log.require("actual_q"), joints())
    assert list(log.columns) == ["actual_q"]


def test_unknown_columns_may_look_like_vectors(tmp_path):
    path = write(tmp_path, table([*JOINTS, "actual_q_x", "output_int_register_7"],
                                 [[*r, "a", 5] for r in joints()]))  # fmt: skip
    assert list(read_log(path, 6).columns) == ["actual_q"]


def test_quoted_headers_and_cells_are_read(tmp_path):
    text = table([f'"{c}"' for c in JOINTS], [[f'"{v}"' for v in r] for r in joints()])
    np.testing.assert_allclose(read_log(write(tmp_path, text), 6).require("actual_q"), joints())


@pytest.mark.parametrize("delimiter", [",", ";"])
def test_a_text_in_quotes_separates_no_cells(tmp_path, delimiter):
    """Recordings of ROS topics as CSV have lists of joint names in a cell."""
    names = f'"[\'a\'{delimiter} ""b""]"'
    rows = [[0.1 * k, names, *r] for k, r in enumerate(joints())]
    path = write(tmp_path, table(["timestamp", "name", *JOINTS], rows, delimiter))
    for log in (read_log(path, 6), *LogPieces(path, 6)):
        np.testing.assert_allclose(log.require("actual_q"), joints())
    rows[1][2] = f'"0{delimiter}5"'
    path = write(tmp_path, table(["timestamp", "name", *JOINTS], rows, delimiter))
    with pytest.raises(LogError, match=f"row 3, column {JOINTS[0]}: found '0{delimiter}5'"):
        read_log(path, 6)


@pytest.mark.parametrize("suffix", [".parquet", ".pq", os.fsdecode(b"\xff.pq")])
def test_parquet_is_the_same_log(tmp_path, suffix):
    path = tmp_path / f"log{suffix}"
    columns = {name: np.array(joints())[:, i] for i, name in enumerate(JOINTS)}
    counts = np.array([1, 2, 3], dtype=np.int32)
    whole = {**columns, "payload": counts, "name": ["a", "b", "c"]}
    with path.open("wb") as file:  # by its name, pyarrow takes UTF-8 only
        parquet.write_table(pyarrow.table(whole), file)
    log = read_log(path, 6)
    assert LogPieces(path, 6).count() == 3
    np.testing.assert_allclose(log.require("actual_q"), joints())
    np.testing.assert_array_equal(log.get("payload"), [1, 2, 3])


def test_parquet_that_is_none_and_text_in_it_are_reported(tmp_path):
    path = write(tmp_path, "not parquet", "log.parquet")
    with pytest.raises(LogError, match="found no readable Parquet file") as caught:
        read_log(path, 6)
    assert "\n" not in str(caught.value)
    parquet.write_table(pyarrow.table({"payload": ["heavy", "light"]}), path)
    with pytest.raises(LogError, match="column payload: found text, expected numbers"):
        read_log(path, 6)


def test_parquet_columns_that_come_twice_or_do_not_fit_are_named(tmp_path):
    path = tmp_path / "log.parquet"
    numbers = pyarrow.array([0.1, 0.2])
    names = ["timestamp", *(f"actual_q_{i}" for i in range(6)), "actual_q_0"]
    parquet.write_table(pyarrow.Table.from_arrays([numbers] * 8, names=names), path)
    with pytest.raises(LogError, match="column actual_q_0: found twice, expected it once"):
        read_log(path, 6)
    stamps = pyarrow.array([2**60 + 1, 2**60 + 3])
    table = pyarrow.Table.from_arrays([stamps, *[numbers] * 6], names=names[:7])
    parquet.write_table(table, path)
    with pytest.raises(LogError, match="column timestamp: "):
        read_log(path, 6)


def test_parquet_with_empty_cells_names_the_cell_when_it_is_needed(tmp_path):
    path = tmp_path / "log.parquet"
    parquet.write_table(pyarrow.table({"payload": [1.0, None, 3.0]}), path)
    with pytest.raises(LogError, match="column payload: found nothing, expected a finite number"):
        read_log(path, 6).require("payload")


def changed(row, column, value):
    rows = joints()
    rows[row][column] = value
    return table(JOINTS, rows)


UNUSABLE = {
    "empty file": ("", "found an empty file, expected a CSV header"),
    "blank file": ("\n\n  \n", "found an empty file"),
    "header alone": (",".join(JOINTS) + "\n", "found no data rows"),
    "ragged": (table(JOINTS, [*joints(2), [1, 2]]), "row 4: found 2 cells, expected 6"),
    "too wide": (table(JOINTS, [[*r, 1] for r in joints()]), "row 2: found 7 cells, expected 6"),
    "a hole between rows": (table(JOINTS, joints(1)) + "\n" + "1,2,3,4,5,6\n",
                            "row 3: found 1 cells, expected 6"),
    "no number": (changed(1, 2, "abc"), "row 3, column actual_q_2: found 'abc', expected a number"),
    "digits apart": (changed(1, 2, "1_0"), "row 3, column actual_q_2: found '1_0', expected a"),
    "two commas": (table(JOINTS, [["1,234,5"] * 6], ";"),
                   "row 2, column actual_q_0: found '1,234,5', expected a number"),
    "after a comment": ("# a\n" + changed(1, 2, "abc"), "row 4, column actual_q_2: found 'abc'"),
    "gap": (table([*JOINTS[:3], *JOINTS[4:]], [[1] * 5]),
            "column actual_q_3: not found, expected 6 columns actual_q_0..5"),
    "first missing": (table(JOINTS[1:], [[1] * 5]), "column actual_q_0: not found"),
    "from 1": (table([f"actual_q_{i}" for i in range(1, 7)], [[1] * 6]),
               "actual_q_0: not found, expected 6 columns actual_q_0..5; they count from 1 here"),
    "capitals": (table(["ACTUAL_Q_0"], [[1]]), "found 'ACTUAL_Q_0', did you mean 'actual_q_0'"),
    "too few joints": (table(JOINTS[:5], [[1] * 5]), "column actual_q_5: not found"),
    "seven joints": (table([*JOINTS, "actual_q_6"], [[1] * 7]),
                     "column actual_q_6: found one too many, expected 6 columns actual_q_0..5 of a "
                     "6-joint arm"),
    "far index": (table([*JOINTS, "actual_q_99"], [[1] * 7]), "actual_q_99: found one too many"),
    "endless index": (table(["actual_q_" + "1" * 5000], [[1]]), "found none that a log may hold"),
    "no index": (table(["actual_q"], [[1]]), "found 'actual_q', did you mean 'actual_q_0'?"),
    "position of two": (table(["measured_position_0", "measured_position_1"], [[1, 2]]),
                        "column measured_position_2: not found, expected 3"),
    "double vector": (table([*JOINTS, "actual_q_3"], [[1] * 7]), "actual_q_3: found twice"),
    "double scalar": (table(["payload", "payload"], [[1, 2]]), "column payload: found twice"),
    "nothing known": (table(["x", "y"], [[1, 2]]), "found none that a log may hold"),
    "misspelt": (table(["mesured_position_0"], [[1]]),
                 "found 'mesured_position_0', did you mean 'measured_position_0'?"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNUSABLE)
def test_unusable_files_are_reported_in_one_line(tmp_path, case):
    text, message = UNUSABLE[case]
    path = write(tmp_path, text)
    with pytest.raises(LogError) as caught:
        read_log(path, 6)
    reported = str(caught.value)
    assert message in reported
    assert reported.startswith(str(path))
    assert "\n" not in reported


def test_a_blank_line_of_an_only_column_is_an_empty_cell(tmp_path):
    path = write(tmp_path, "actual_q_0\n0.1\n\n0.3\n")
    for log in (read_log(path, 1), *LogPieces(path, 1)):
        np.testing.assert_array_equal(log.columns["actual_q"][:, 0], [0.1, np.nan, 0.3])
        with pytest.raises(LogError, match="row 3, column actual_q_0: found nothing"):
            log.require("actual_q")


def test_what_is_no_text_is_reported(tmp_path):
    path = tmp_path / "log.csv"
    path.write_bytes(b"\x80\x81\x00\x01" * 10)
    with pytest.raises(LogError, match="no text"):
        read_log(path, 6)
    with pytest.raises(LogError, match="file not found"):
        read_log(tmp_path / "none.csv", 6)
    with pytest.raises(LogError, match="found a folder that is no data source"):
        read_log(tmp_path, 6)


@pytest.mark.parametrize("value", ["nan", "NaN", "inf", "-inf", ""])
def test_a_cell_that_is_not_finite_is_named_when_it_is_needed(tmp_path, value):
    log = read_log(write(tmp_path, changed(1, 4, value)), 6)
    with pytest.raises(LogError, match=r"row 3, column actual_q_4: found (nothing|-?inf),"):
        log.require("actual_q")


def test_a_selection_holds_its_rows_only(tmp_path):
    log = read_log(write(tmp_path, table(["payload", *JOINTS], [[7, *r] for r in joints()])), 6)
    np.testing.assert_array_equal(log.select(np.array([2, 0])).get("actual_q")[:, 0], [2, 0])
    assert len(log.select(slice(1, None))) == 2


def test_a_selection_of_a_selection_names_the_lines_of_the_file(tmp_path):
    rows = [[*r, 5.0] for r in joints(9)]
    rows[6][6], rows[7][2] = -1.0, "nan"
    log = read_log(write(tmp_path, table([*JOINTS, "payload"], rows)), 6)
    assert log.line(6) == 8
    part = log.select(np.arange(9) % 2 == 0).select(slice(1, None)).select(np.array([2, 0, 1]))
    assert [part.line(row) for row in range(3)] == [8, 4, 6]
    with pytest.raises(LogError, match="row 8, column payload: found -1"):
        part.loads()
    with pytest.raises(LogError, match="row 9, column actual_q_2: found nothing"):
        log.select(np.array([0, 7])).require("actual_q")


def test_a_missing_column_is_named_with_its_alternative(tmp_path):
    log = read_log(write(tmp_path, table(["payload"], [[1]])), 6)
    with pytest.raises(LogError, match=r"found no actual_q_0\.\.5 or target_q_0\.\.5, expected"):
        log.require("actual_q", "target_q")


@pytest.mark.parametrize(
    ("header", "hint"),
    [
        ("target_qq_{}", "; found target_qq_0; did you mean target_q_0?"),
        ("Actual_Q_{}", "; found Actual_Q_0; did you mean actual_q_0?"),
        ("actual_q{}", "; found actual_q0; did you mean actual_q_0?"),
        ("target_qd_{}", ""),  # RTDE has that field
        ("elbow_{}", ""),
    ],
)
@pytest.mark.parametrize("kind", ["csv", "parquet"])
def test_a_misspelt_column_is_named_where_the_right_one_is_missing(tmp_path, header, hint, kind):
    names = [*(header.format(i) for i in range(6)), "payload"]
    path = tmp_path / f"log.{kind}"
    if kind == "csv":
        path.write_text(table(names, [range(7)]), encoding="utf-8")
    else:
        parquet.write_table(pyarrow.table({name: [1.0] for name in names}), path)
    log = read_log(path, 6)
    with pytest.raises(LogError) as caught:
        log.select(slice(None)).require("actual_q", "target_q")
    wanted = "found no actual_q_0..5 or target_q_0..5, expected them for this command"
    assert str(caught.value) == f"{path}: columns: {wanted}{hint}"


@pytest.mark.parametrize("value", ["inf", "-inf", "nan"])
@pytest.mark.parametrize("name", ["actual_q", "target_q"])
def test_an_angle_that_is_not_finite_is_reported_with_its_row_not_as_degrees(tmp_path, value, name):
    rows = joints()
    rows[1][3] = value
    log = read_log(write(tmp_path, table([f"{name}_{i}" for i in range(6)], rows)), 6)
    if value == "nan":  # an empty cell is reported where it is needed, and only there
        check_units(Model(builtin_arm("ur5e")), log)
    with pytest.raises(LogError) as caught:
        log.require(name) if value == "nan" else check_units(Model(builtin_arm("ur5e")), log)
    found = "nothing" if value == "nan" else value
    assert f"row 3, column {name}_3: found {found}, expected a finite number" in str(caught.value)
    assert "degrees" not in str(caught.value)


def test_loads_come_from_their_columns_and_a_negative_payload_is_reported(tmp_path):
    names = [*JOINTS, "payload", *(f"payload_cog_{i}" for i in range(3)),
             *(f"actual_TCP_force_{i}" for i in range(6))]  # fmt: skip
    rows = [[*r, 2.5, 0.1, 0.2, 0.3, 1, 2, 3, 4, 5, 6] for r in joints()]
    loads = read_log(write(tmp_path, table(names, rows)), 6).loads()
    np.testing.assert_array_equal(loads.payload_mass, 2.5)
    np.testing.assert_array_equal(loads.payload_cog[1], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(loads.wrench[2], [1, 2, 3, 4, 5, 6])
    assert loads.temperature is None
    rows[1][6] = -0.5
    with pytest.raises(LogError, match=r"row 3, column payload: found -0\.5, expected 0 or"):
        read_log(write(tmp_path, table(names, rows)), 6).loads()


def test_the_approach_is_the_last_motion_carried_on_through_stillness():
    q = np.array([[0.0, 0], [1, 0], [1, 0], [0.5, 1e-9], [0.5, -1]])
    np.testing.assert_array_equal(last_motion(q), [[0, 0], [1, 0], [1, 0], [-1, 0], [-1, -1]])


def test_the_approach_that_a_log_states_counts(tmp_path):
    names = [*JOINTS, *(f"approach_{i}" for i in range(6))]
    log = read_log(write(tmp_path, table(names, [[*r, -1, 1, 0, 2, -0.5, 1] for r in joints()])), 6)
    np.testing.assert_array_equal(log.approach()[1], [-1, 1, 0, 1, -1, 1])
    rising = read_log(write(tmp_path, table(JOINTS, joints())), 6)
    np.testing.assert_array_equal(rising.approach(), [[0] * 6, [1] * 6, [1] * 6])


@pytest.mark.skipif(not RECORDING.is_file(), reason=f"{RECORDING} is not there")
def test_a_recording_of_a_ur_is_a_log_as_it_stands():
    with RECORDING.open() as file:
        header = file.readline().strip().split(",")
        first = dict(zip(header, file.readline().strip().split(","), strict=True))
    log = read_log(RECORDING, 6)
    assert len(header) == 121
    assert len(log) == 888
    for name in ("target_q", "actual_q", "actual_qd", "actual_TCP_force"):
        np.testing.assert_array_equal(
            log.require(name)[0], [float(first[f"{name}_{i}"]) for i in range(6)]
        )
    assert log.loads().wrench.shape == (888, 6)


def test_without_angles_there_is_no_approach(tmp_path):
    assert read_log(write(tmp_path, "payload\n1\n"), 2).approach() is None


def test_temperatures_of_the_joints_are_a_load(tmp_path):
    names = [f"joint_temperatures_{i}" for i in range(6)]
    loads = read_log(write(tmp_path, table(names, [range(30, 36)])), 6).loads()
    np.testing.assert_array_equal(loads.temperature, [[30, 31, 32, 33, 34, 35]])
    assert loads.payload_mass is None
