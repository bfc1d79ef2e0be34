"""Instruments: parsing of numbers and units, files, folders, sockets."""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cell_operator import CellOperator
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from rtde_receive import RTDEReceiveInterface

from gapbridge.bridge.calibration.instruments import INSTRUMENTS
from gapbridge.bridge.calibration.instruments.instrument import (
    AnyInstrument,
    InstrumentContext,
    ReadingError,
    ReadRequest,
)
from gapbridge.bridge.calibration.instruments.numbers import parse_numbers
from gapbridge.bridge.calibration.joints.joint_source import TypedJoints
from gapbridge.bridge.cell.settings.instruments import InstrumentSettings
from gapbridge.bridge.demo.links.link import free_address
from gapbridge.bridge.demo.links.ur_rtde import UrRtdeLink
from gapbridge.bridge.demo.processes import ServedCell
from gapbridge.core.calibration.plan import Payload, PlannedPose
from gapbridge.core.errors import InputError, LinkError

SETTINGS: TypeAdapter[InstrumentSettings] = TypeAdapter(InstrumentSettings)


def instrument(kind: str, *lines: str, since: float = 0.0, **keys: Any) -> AnyInstrument:
    """Return an instrument at a terminal where these lines are typed."""
    typed = iter(lines)
    context = InstrumentContext(ask=lambda question: next(typed), since=since)
    settings = SETTINGS.validate_python({"kind": kind, **keys})
    return INSTRUMENTS[settings.kind](settings, context)


def test_every_kind_that_a_cell_may_name_has_an_instrument() -> None:
    kinds = set(SETTINGS.json_schema()["discriminator"]["mapping"])
    assert kinds == set(INSTRUMENTS)


@pytest.mark.parametrize(
    "line",
    [
        "1234.5 -67.25 890", "1234.5, -67.25, 890", "1234,5; -67,25; 890", "1234,5\t-67,25\t890",
        "X=1234.5 Y=-67.25 Z=890", "1234.5 mm, -67.25 mm, 890 mm", "  1234.5,-67.25,890.0  ",
        "x: 1.2345e3, y: -67.25, z: 890", "1234,5 -67,25 890,0", "1234.5 -67.25 890 MM",
    ],
)  # fmt: skip
def test_a_point_is_understood_however_it_is_written(line: str) -> None:
    reader = instrument("typed", line, unit="mm").read(ReadRequest()).values
    np.testing.assert_allclose(reader, [[1.2345, -0.06725, 0.890]], rtol=1e-12)


@pytest.mark.parametrize(
    ("line", "phrase"),
    [
        ("1 2", "found 2 numbers in '1 2', expected 3"),
        ("1 2 3 4", "found 4 numbers"),
        ("1 2 x", "found 'x', expected a number"),
        ("1 2 nan", "expected finite numbers"),
        ("1 m 2 m 3 m", "found m, expected mm"),
        ("1 deg 2 3", "found deg, expected mm"),
        ("1 cm 2 cm 3 cm", "found cm, expected mm"),
        ('1" 2" 3"', 'found ", expected mm'),
        ("1 2 3 inch", "found inch, expected mm"),
        ("1_0 2 3", "found '1_0', expected a number"),
        ("", "found 0 numbers"),
        ("1e9 2 3", "is the unit right?"),
    ],
)
def test_an_invalid_point_is_reported_with_the_reason(line: str, phrase: str) -> None:
    with pytest.raises(ReadingError, match=phrase.replace("?", r"\?")):
        instrument("typed", line, unit="mm").read(ReadRequest())


@settings(deadline=None)
@given(st.lists(st.floats(-9e4, 9e4), min_size=3, max_size=3), st.sampled_from([" ", ", ", "; "]))
def test_numbers_read_back_exactly_whatever_stands_between_them(
    values: list[float], between: str
) -> None:
    assert parse_numbers(between.join(repr(v) for v in values), 3) == values


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ({"rotation": "rotation_vector"}, "1 2 3 0 0 90"),
        ({"rotation": "rpy"}, "1 2 3 0 0 90"),
        ({"rotation": "quaternion"}, f"1 2 3 0 0 {0.5**0.5} {0.5**0.5}"),
        ({"rotation": "rpy", "angle_unit": "rad"}, f"1 2 3 0 0 {np.pi / 2}"),
    ],
)
def test_a_pose_is_the_same_however_its_rotation_is_reported(
    keys: dict[str, str], line: str
) -> None:
    reader = instrument("typed", line, unit="m", pose=True, **keys).read(ReadRequest()).values[0]
    np.testing.assert_allclose(reader, [1, 2, 3, 0, 0, np.pi / 2], atol=1e-9)


@pytest.mark.parametrize(
    ("unit", "line"), [("deg", "1 2 3 0 0 1.5 rad"), ("rad", "1 m 2 m 3 m 0 0 1°")]
)
def test_an_angle_with_another_unit_is_refused(unit: str, line: str) -> None:
    reader = instrument("typed", line, unit="m", pose=True, angle_unit=unit)
    with pytest.raises(ReadingError, match=f"expected {unit}: the unit declared for it"):
        reader.read(ReadRequest())


def test_joints_typed_in_radians_by_name_are_refused() -> None:
    joints = TypedJoints(lambda question: "0.5 rad 0.1 rad -1.2 rad")
    with pytest.raises(ReadingError, match="found rad, expected deg"):
        joints.sample_at_rest(PlannedPose(0, np.zeros(3), 0, np.zeros(3)))


def test_degrees_declared_as_radians_are_refused() -> None:
    with pytest.raises(ReadingError, match="is the unit right"):
        instrument("typed", "1 2 3 0 0 90", unit="m", pose=True, angle_unit="rad").read(
            ReadRequest()
        )


def test_a_dial_gauge_counts_from_its_zero() -> None:
    reader = instrument("dial_gauge", "0,25 mm", unit="mm", zero=500.0).read(ReadRequest()).values
    np.testing.assert_allclose(reader, [[0.50025]])


def test_two_balls_give_their_difference_and_one_ball_twice_is_refused() -> None:
    reader = instrument("two_balls", "1 2 3", "101 2 3", unit="mm").read(ReadRequest()).values
    np.testing.assert_allclose(reader, [[0.1, 0.0, 0.0]], atol=1e-12)
    with pytest.raises(ReadingError, match="same place"):
        instrument("two_balls", "1 2 3", "1 2 3", unit="mm").read(ReadRequest())


def test_a_sphere_needs_no_number() -> None:
    assert instrument("sphere", "").read(ReadRequest()).values.shape == (1, 0)


def test_a_file_gives_row_after_row_and_waits_for_the_next(tmp_path: Path) -> None:
    file = tmp_path / "readings.csv"
    file.write_text("time;x;y;z\n1;100,5;2;3\n2;200;2;3\n3;300;2", encoding="utf-8")
    reader = instrument("file", unit="mm", file=str(file), timeout=5.0)
    first = reader.read(ReadRequest())
    np.testing.assert_allclose(first.values, [[0.1005, 0.002, 0.003]])
    second = reader.read(ReadRequest(used=frozenset({first.source})))
    assert second.values[0, 0] == pytest.approx(0.2)
    used = frozenset({first.source, second.source})
    threading.Timer(0.2, lambda: file.open("a").write(";3\n")).start()
    assert reader.read(ReadRequest(used=used)).values[0, 0] == pytest.approx(0.3)


def test_a_file_with_stops_gives_each_stop_its_last_row(tmp_path: Path) -> None:
    file = tmp_path / "readings.csv"
    file.write_text("stop,x,y,z\n1,1,0,0\n2,2,0,0\n1,3,0,0\n", encoding="utf-8")
    reader = instrument("file", unit="m", file=str(file), timeout=0.2)
    first = reader.read(ReadRequest(stop=1))
    assert first.values[0, 0] == 3.0
    again = ReadRequest(stop=1, used=frozenset({first.source}))  # discarded: neither row any more
    with pytest.raises(ReadingError, match=r"no new row .* expected stop 1"):
        reader.read(again)
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("1,3,0,0", "1,3.5,0,0"), encoding="utf-8")
    assert reader.read(again).values[0, 0] == 3.5  # corrected in its place
    assert reader.read(ReadRequest(stop=2)).values[0, 0] == 2.0
    with pytest.raises(ReadingError, match=r"no new row .* expected stop 3"):
        reader.read(ReadRequest(stop=3))


@pytest.mark.parametrize(
    ("text", "phrase"),
    [
        ("1,2\n", "row 1: found 2 numbers"),
        ("x,y,z\n1,2,q\n", "row 2: found 'q'"),
        ("n,x,y,z\n1,100,200\n", "row 2: found 3 cells, expected 4 as in the header"),
        ("x,y,z\n1,5,2,5,3,5\n", "row 2: found 6 cells, expected 3"),
        ("x,y,z\n12.5 in,3.0 in,4.0 in\n", "row 2: found in, expected m: the unit declared"),
    ],
)
def test_a_bad_row_is_named(tmp_path: Path, text: str, phrase: str) -> None:
    file = tmp_path / "readings.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ReadingError, match=phrase):
        instrument("file", unit="m", file=str(file)).read(ReadRequest())


@pytest.mark.parametrize("columns", [None, ("X [in]", "Y [in]", "Z [in]")])
def test_a_header_with_another_unit_is_refused(
    tmp_path: Path, columns: tuple[str, ...] | None
) -> None:
    file = tmp_path / "readings.csv"
    file.write_text("T (deg),X [in],Y [in],Z [in]\n20,39.37,78.74,11.81\n", encoding="utf-8")
    keys = {"file": str(file), "columns": columns}
    with pytest.raises(InputError, match=r"csv: column X \[in\]: found in, expected mm: the unit"):
        instrument("file", unit="mm", **keys).read(ReadRequest())
    found = instrument("file", unit="in", **keys).read(ReadRequest())
    np.testing.assert_allclose(found.values, [[1.0, 2.0, 0.3]], rtol=1e-3)


def test_a_row_too_short_for_its_named_columns_is_named(tmp_path: Path) -> None:
    file = tmp_path / "readings.csv"
    file.write_text("n,x,y,z\n1,100,200\n", encoding="utf-8")
    reader = instrument("file", columns=("x", "y", "z"), unit="m", file=str(file))
    with pytest.raises(ReadingError, match=r"readings\.csv: row 2: found 3 cells"):
        reader.read(ReadRequest())


@pytest.mark.parametrize(
    "text", ["x,y,z\r1,2,3\r", "x,y,z\r\n1,2,3\r\n", "x,y,z\n1,2,3,\n", "x,y,z,\n1,2,3,\n",
             "# of a tracker\n1,2,3\n"]
)  # fmt: skip
def test_line_ends_separators_at_them_and_a_title_do_not_matter(tmp_path: Path, text: str) -> None:
    file = tmp_path / "readings.csv"
    file.write_bytes(text.encode())
    found = instrument("file", unit="m", file=str(file), timeout=1.0).read(ReadRequest())
    np.testing.assert_allclose(found.values, [[1, 2, 3]])


def test_what_is_no_csv_is_unusable_input(tmp_path: Path) -> None:
    file = tmp_path / "readings.csv"
    file.write_text(f"x,y,z\n{'1' * 200_000},2,3\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"readings\.csv: found field larger"):
        instrument("file", unit="m", file=str(file)).read(ReadRequest())


def test_columns_are_found_by_name_and_a_missing_one_is_reported(tmp_path: Path) -> None:
    file = tmp_path / "readings.csv"
    file.write_text("z,y,x,rms\n3,2,1,0.1\n", encoding="utf-8")
    keys = {"unit": "m", "file": str(file)}
    reader = instrument("file", columns=("x", "y", "z"), **keys).read(ReadRequest())
    np.testing.assert_allclose(reader.values, [[1, 2, 3]])
    with pytest.raises(InputError, match="column w: found none"):
        instrument("file", columns=("w", "y", "z"), **keys).read(ReadRequest())
    file.write_text("x,y,z,x,y,z\n1,2,3,1.1,2.1,3.1\n", encoding="utf-8")  # nominal, measured
    with pytest.raises(InputError, match="column x: found it twice"):
        instrument("file", columns=("x", "y", "z"), **keys).read(ReadRequest())


def test_readings_from_before_a_session_are_known(tmp_path: Path) -> None:
    file, now = tmp_path / "readings.csv", time.time()
    file.write_text("x,y,z\n1,2,3\n4,5,6\n", encoding="utf-8")
    os.utime(file, (now - 60, now - 60))
    keys = {"unit": "m", "file": str(file)}
    assert instrument("file", since=now - 30, **keys).earlier(False) == ("row 2", "row 3")
    assert instrument("file", since=now - 90, **keys).earlier(False) == ()  # a complete file
    assert instrument("file", since=now - 90, **keys).earlier(True) == ("row 2", "row 3")
    folder = instrument("folder", unit="m", folder=str(tmp_path))
    assert (folder.earlier(False), folder.earlier(True)) == ((), ("readings.csv",))
    assert instrument("typed", unit="m").earlier(True) == ()


def test_a_watched_folder_gives_whole_new_files_oldest_first(tmp_path: Path) -> None:
    now = time.time()
    for name, age, text in (
        ("old", 100.0, "9 9 9"), ("b", 5.0, "1 0 0\n2 0 0"), ("a", 2.0, "4,5;0;0"),
    ):  # fmt: skip
        path = tmp_path / f"{name}.csv"
        path.write_text(text, encoding="utf-8")
        os.utime(path, (now - age, now - age))
    reader = instrument("folder", unit="m", folder=str(tmp_path), timeout=0.4, since=now - 50)
    first = reader.read(ReadRequest())
    np.testing.assert_allclose(first.values, [[1, 0, 0], [2, 0, 0]])
    second = reader.read(ReadRequest(used=frozenset({first.source})))
    np.testing.assert_allclose(second.values, [[4.5, 0, 0]])
    with pytest.raises(ReadingError, match="no new file"):
        reader.read(ReadRequest(used=frozenset({first.source, second.source})))


def _serve(answers: list[bytes]) -> int:
    """Serve one connection after the other with these bytes; returns the port."""
    listener = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        for answer in answers:
            link, _ = listener.accept()
            with link:
                link.sendall(answer)
        listener.close()

    threading.Thread(target=run, daemon=True).start()
    return int(listener.getsockname()[1])


def test_a_line_feed_averages_lines_and_reports_a_closed_connection() -> None:
    port = _serve([b"", b"1 2 3\r\n\n3 2 3\n", b"1 2 3\n"])
    reader = instrument("line_feed", unit="m", port=port)
    reader.open()
    np.testing.assert_allclose(reader.read(ReadRequest(samples=2)).values, [[1, 2, 3], [3, 2, 3]])
    with pytest.raises(LinkError, match="the connection was closed"):
        reader.read(ReadRequest(samples=2))


def test_an_instrument_that_cannot_be_reached_is_reported(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with pytest.raises(LinkError, match="expected the tracker's software"):
        instrument("line_feed", unit="m", port=port).open()
    with pytest.raises(LinkError, match="gapbridge simulate"):
        instrument("simulated_tracker", host="127.0.0.1", port=port).open()
    with pytest.raises(InputError, match="no such folder"):
        instrument("folder", unit="m", folder=str(tmp_path / "none")).open()
    with pytest.raises(InputError, match="no such file"):
        instrument("file", unit="m", file=str(tmp_path / "none" / "x.csv")).open()


def test_the_simulated_tracker_mounts_the_confirmed_load(tmp_path: Path) -> None:
    host = free_address(UrRtdeLink.ports)
    cell = tmp_path / "cell.yaml"
    cell.write_text(f"robot: {{model: ur10e}}\nlink: {{host: {host}}}\n", encoding="utf-8")
    with ServedCell(cell, 3), instrument("simulated_tracker", host=host) as tracker:
        operator, state = CellOperator(host), RTDEReceiveInterface(host)
        tracker.set_load(Payload(9.5, (0.0, 0.01, 0.09), "plate"))
        assert json.loads(operator.bench("truth"))["payload"] == {
            "mass": 9.5,
            "cog": [0.0, 0.01, 0.09],
        }
        latest = time.monotonic() + 60
        while state.getPayload() != 9.5 and time.monotonic() < latest:
            time.sleep(0.05)
        assert state.getPayload() == 9.5
        np.testing.assert_allclose(state.getPayloadCog(), [0.0, 0.01, 0.09])
        assert tracker.read(ReadRequest(samples=3)).values.shape == (3, 3)
        state.disconnect()
