"""The replaying driver: states as they were recorded, in their time, and clear refusals."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
from link_settings import link_settings
from recorded import Desk

from gapbridge.bridge.cell import load_cell
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import LogError
from gapbridge.core.model import Model
from gapbridge.drivers import make_driver
from gapbridge.drivers.replay.driver import EndOfRecordingError, ReplayDriver

MODEL = Model(builtin_arm("ur5e"))


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path / "recordings")


def driver(desk: Desk, speed: float = 100.0) -> ReplayDriver:
    found = make_driver(link_settings(driver="replay", file=desk.stem, speed=speed), MODEL)
    assert isinstance(found, ReplayDriver)
    return found


def test_states_come_back_as_they_were_and_then_there_is_an_end(desk: Desk) -> None:
    rows = desk.record(30, 20)
    part = desk.memory.slices
    with driver(desk) as replay:
        assert replay.n == 6
        assert replay.rate == rows[0, part["rate"].start]
        for row in rows:
            state = replay.read_state()
            assert state.timestamp == row[1]
            assert np.array_equal(state.actual_q, row[part["actual_q"]])
            assert np.array_equal(replay.nominal_q(state), row[part["own_q"]])
            assert state.payload == row[part["payload"].start]
            assert state.joint_temperatures is None  # not a number, then
            assert replay.cycle is not None
            assert replay.cycle.number == row[0]
        for _ in range(2):
            with pytest.raises(EndOfRecordingError, match="come to its end"):
                replay.read_state()


def test_arrays_are_of_the_kind_that_the_loop_was_compiled_for(desk: Desk) -> None:
    """Another kind is compiled amidst a cycle, for seconds, and a loop that hangs is ended."""
    desk.record(1, 3)  # a chunk of one cycle was handed on as the file's own bytes
    with driver(desk) as replay:
        for _ in range(4):
            state = replay.read_state()
            arrays = [value for value in state if isinstance(value, np.ndarray)]
            assert len(arrays) > 5
            for array in (*arrays, replay.nominal_q(state), replay.cycle.nominal_q):  # type: ignore[union-attr]
                assert array.dtype == np.float64
                assert array.flags.carray  # in one piece, aligned, writable


@pytest.mark.realtime(limit=0.2)
def test_it_takes_as_long_as_it_took_divided_by_the_speed(desk: Desk) -> None:
    desk.record(200)  # 0.398 s
    for speed, longest in ((1.0, 0.398), (4.0, 0.0995)):
        with driver(desk, speed) as replay:
            begun = time.monotonic()
            for _ in range(200):
                replay.read_state()
            assert longest - 0.005 < time.monotonic() - begun < longest + 0.3


def test_a_cell_that_names_no_recording_is_one_line(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: {model: ur5e}\nlink: {driver: replay, file: run-1}\n")
    with pytest.raises(LogError, match=r"cell\.yaml, line 2: link\.file: .*run-1: file not found"):
        _ = load_cell(cell).link


def test_a_recording_is_found_from_the_cells_folder(desk: Desk, tmp_path: Path) -> None:
    desk.record(3)
    cell = tmp_path / "cell.yaml"
    cell.write_text(
        f"robot: {{model: ur5e}}\nlink: {{driver: replay, file: recordings/{desk.stem.name}}}\n"
    )
    assert load_cell(cell).link.file == desk.stem.resolve()  # type: ignore[union-attr]


def test_a_recording_of_another_arm_or_of_nothing_is_refused(desk: Desk) -> None:
    desk.recorder().close()
    with pytest.raises(LogError, match="found no cycles, expected a recording to replay"):
        driver(desk)
    desk.record(3)
    seven = Path(__file__).parents[3] / "config" / "seven_axis_urdf.yaml"
    settings = link_settings(driver="replay", file=desk.stem)
    with pytest.raises(LogError, match="found 6 joints, expected 7"):
        make_driver(settings, load_cell(seven).model)
