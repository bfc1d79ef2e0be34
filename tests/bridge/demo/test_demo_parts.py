"""The demo's parts, each on data with a known result."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from on_a_phone import CHROMIUM, faults_on_a_phone
from rich.console import Console

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.demo.hidden import HiddenEffects, NamedCause
from gapbridge.bridge.demo.measurements import (
    Measurements,
    TooFewReadingsError,
    joined,
    measurements_at,
    write_log,
)
from gapbridge.bridge.demo.page import page
from gapbridge.bridge.demo.picture import picture
from gapbridge.bridge.demo.poses import CALIBRATION_LOADS, TEST_LOADS, UR10E, candidates, plan
from gapbridge.bridge.demo.result import LoopFigures, Result, repeatability
from gapbridge.bridge.demo.session import RunOutcome, Session
from gapbridge.bridge.demo.terminal import bar, show
from gapbridge.bridge.demo.trajectory import (
    ACCELERATION,
    MAX_SPEED,
    PERIOD,
    SPEED_SHARE,
    visit_trajectory,
)
from gapbridge.bridge.document.svg import svg_file
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.bridge.setpoint_source.quintic import write_trajectory
from gapbridge.core.arm import builtin_arm
from gapbridge.core.compensation import correct
from gapbridge.core.errors import RunError
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import read_log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason
from gapbridge.core.rotation import rotation_vector, transform
from gapbridge.drivers.clock import Clock

HOME = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
MODEL = Model(builtin_arm("ur10e"), transform(np.eye(3), np.array([0, 0, 0.18])))
TOP_SPEED = MODEL.arm.limits.velocity
SOFT = MODEL.with_compliance(
    [4e-6, 6e-6, 6e-6, 9e-6, 1e-5, 1e-5], [6e-7, 8e-7, 1e-6, 1e-6, 2e-6, 3e-6]
)


def measured(
    q: np.ndarray, nominal: np.ndarray, load: int, scatter: float, seed: int
) -> Measurements:
    """Return simulated tracker measurements of a deflected arm at encoder angles q (N, n)."""
    random = np.random.default_rng(seed)
    loads = TEST_LOADS[load].rows(len(q))
    poses = SOFT.predict(q, loads)
    position = poses.position + random.normal(0, scatter, (len(q), 3))
    assert loads.payload_mass is not None
    assert loads.payload_cog is not None
    assert loads.wrench is not None
    return Measurements(
        np.arange(len(q)) * 1.0, nominal, q, loads.payload_mass, loads.payload_cog, loads.wrench,
        position, rotation_vector(poses.rotation),
    )  # fmt: skip


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """A demo result whose measurements come from the model, with scatter."""
    given = plan(MODEL, HOME, 4)
    scatter = 1e-5
    runs = [
        measured(np.vstack([q, q]), np.vstack([q, q]), k % 2, scatter, k)
        for k, q in enumerate((*given.calibration, *given.test))
    ]
    path = tmp_path_factory.mktemp("demo") / "log.csv"
    write_log(path, joined(runs))
    found = identify_compliance(MODEL, read_log(path, 6), Metrology(True, scatter))
    corrected = [
        correct(found.model, q, TEST_LOADS[k].rows(len(q))).q for k, q in enumerate(given.test)
    ]
    return Result(
        link="ur_rtde", seed=4, identification=found, model=found.model,
        uncompensated=joined(
            [measured(q, q, k, scatter, 20 + k) for k, q in enumerate(given.test)]
        ),
        compensated=joined(
            [measured(c, q, k, scatter, 30 + k)
             for k, (c, q) in enumerate(zip(corrected, given.test, strict=True))]
        ),
        loads=tuple(load.name for load, q in zip(TEST_LOADS, given.test, strict=True) for _ in q),
        setpoints_written=1000, loop=LoopFigures(500.0, 1, 1000, 2100.0), duration=1.0,
    )  # fmt: skip


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_planned_poses_are_free_and_none_is_tested_that_was_fitted(seed: int) -> None:
    given = plan(MODEL, HOME, seed)
    assert len(given.calibration) == len(CALIBRATION_LOADS)
    fitted, tested = np.vstack(given.calibration), np.vstack(given.test)
    position = MODEL.rigid_pose(np.vstack([fitted, tested])).position
    assert position[:, 2].min() > 0.15
    for pose in tested:
        assert np.abs(fitted - pose).max(axis=1).min() > 0.02
    for rows, times in zip(given.test, UR10E.visits, strict=True):
        assert len(np.unique(rows, axis=0)) * times == len(rows)
    assert len(np.unique(tested, axis=0)) == UR10E.test_poses * len(given.test)


def test_another_seed_draws_other_poses() -> None:
    assert not np.array_equal(candidates(MODEL, 1)[:5], candidates(MODEL, 2)[:5])


def test_a_trajectory_rests_at_every_pose_and_keeps_its_limits(tmp_path: Path) -> None:
    poses = plan(MODEL, HOME, 1).calibration[0]
    q = visit_trajectory(HOME, poses, TOP_SPEED)
    speed = np.diff(q, axis=0) / PERIOD
    share = (np.abs(speed) / np.minimum(SPEED_SHARE * TOP_SPEED, MAX_SPEED)).max()
    assert 0.7 < share < 1.05
    assert np.abs(np.diff(speed, axis=0)).max() / PERIOD < 1.2 * ACCELERATION
    np.testing.assert_array_equal(q[[0, -1]], [HOME, HOME])
    for pose in poses:
        assert (q == pose).all(axis=1).sum() * PERIOD > 0.3
    duration = write_trajectory(tmp_path / "t.csv", q, PERIOD)
    log = read_log(tmp_path / "t.csv", 6)
    assert duration == pytest.approx((len(q) - 1) * PERIOD)
    np.testing.assert_array_equal(log.require("target_q"), q)


def recording(q: np.ndarray, start: float = 100.0) -> dict[str, np.ndarray]:
    return {
        "timestamp": start + np.arange(len(q)) * PERIOD,
        "actual_q": q,
        "actual_qd": np.gradient(q, PERIOD, axis=0),
        "payload": np.full(len(q), 5.0),
        "payload_cog": np.zeros((len(q), 3)),
        "actual_TCP_force": np.zeros((len(q), 6)),
    }


def test_measurements_hold_only_readings_taken_after_settling() -> None:
    poses = HOME + np.array([[0.3, 0, 0, 0, 0, 0], [0, 0.4, 0, 0, 0, 0], [0.3, 0, 0, 0, 0, 0]])
    given = recording(visit_trajectory(HOME, poses, TOP_SPEED))
    t = given["timestamp"][::5]
    readings = np.zeros((len(t), 7))
    readings[:, 0] = t
    readings[:, 1:4] = given["actual_q"][::5, :3]
    flips = np.where(np.arange(len(t)) % 2, 1, -1)[:, None]  # one rotation, written two ways
    readings[:, 4:] = flips * [np.pi - 1e-9, 0, 0]
    found, missing = measurements_at(given, readings, poses)
    assert found is not None
    assert missing is None
    np.testing.assert_allclose(found.actual_q, poses, atol=1e-7)
    np.testing.assert_allclose(found.position, poses[:, :3], atol=1e-7)
    np.testing.assert_allclose(np.abs(found.rotation), np.tile([np.pi, 0, 0], (3, 1)), atol=1e-6)


def test_a_visit_that_never_happened_is_reported() -> None:
    given = recording(visit_trajectory(HOME, HOME + np.array([[0.3, 0, 0, 0, 0, 0]]), TOP_SPEED))
    readings = np.zeros((10, 7))
    elsewhere, unseen = (
        measurements_at(given, readings, HOME + np.array([shift]))
        for shift in ([0, 0.5, 0, 0, 0, 0], [0.3, 0, 0, 0, 0, 0])
    )
    assert elsewhere[0] is None
    assert str(elsewhere[1]) == "visit 1 of 1: the arm was never at rest there"
    assert unseen[0] is None
    assert isinstance(unseen[1], TooFewReadingsError)
    assert str(unseen[1]) == "visit 1: found 0 readings of the tracker, expected 8"


def test_a_rest_that_was_not_recorded_is_measured_again() -> None:
    """A stalled machine records the beginning and the end of a rest, and nothing between them."""
    poses = HOME + np.array([[0.3, 0, 0, 0, 0, 0]])
    given = recording(visit_trajectory(HOME, poses, TOP_SPEED))
    there = np.flatnonzero(np.abs(given["actual_q"] - poses[0]).max(axis=1) < 1e-6)
    kept = np.setdiff1d(np.arange(len(given["timestamp"])), there[1:-1])
    times = given["timestamp"][there[1:-1]]
    readings = np.column_stack([times, np.zeros((len(times), 6))])
    assert measurements_at(given, readings, poses)[1] is None
    gap = {name: values[kept] for name, values in given.items()}
    found, missing = measurements_at(gap, readings, poses)
    assert found is None
    assert isinstance(missing, TooFewReadingsError)
    assert "visit 1: found no recorded cycle between" in str(missing)


def test_the_age_behind_a_setpoint_is_of_runs_that_wrote_some(tmp_path: Path) -> None:
    session: Any = Session(None, tmp_path, lambda _: None, Clock())  # type: ignore[arg-type]
    run = {"cycles": 500, "missed": 5, "rate_hz": 500.0}
    session._runs = [
        SimpleNamespace(**run, setpoints_written=0, age_ms={"p99": 50.0}),  # ended before it armed
        SimpleNamespace(**run, setpoints_written=480, age_ms={"p99": 0.8}),
    ]
    assert session.figures() == LoopFigures(rate=500.0, missed=10, cycles=1010, p99=800.0)


def test_repeatability_is_that_of_the_scatter() -> None:
    random = np.random.default_rng(3)
    q = np.repeat(random.uniform(-1, 1, (200, 6)), 2, axis=0)
    position = np.repeat(random.uniform(-1, 1, (200, 3)), 2, axis=0)
    position = position + random.normal(0, 2e-5, position.shape)
    empty = np.zeros((len(q), 6))
    run = Measurements(empty[:, 0], q, q, empty[:, 0], empty[:, :3], empty, position, empty[:, :3])
    found = repeatability([run], ("a",) * len(q))
    assert found == pytest.approx(2e-5 * np.sqrt(3), rel=0.15)


def test_the_summary_holds_what_was_measured(result: Result) -> None:
    summary = result.summary()
    assert set(summary) >= {
        "link", "samples", "tcp_error_mm", "repeatability_mm", "setpoints_written", "loop"
    }  # fmt: skip
    wanted = MODEL.rigid_pose(result.uncompensated.nominal_q).position
    distance = np.linalg.norm(result.uncompensated.position - wanted, axis=1) * 1e3
    assert summary["tcp_error_mm"]["without"]["max"] == pytest.approx(distance.max())
    assert summary["tcp_error_mm"]["without"]["rms"] == pytest.approx(np.sqrt(np.mean(distance**2)))
    assert summary["tcp_error_mm"]["without"]["rms"] > 20 * summary["tcp_error_mm"]["with"]["rms"]
    assert summary["tcp_error_mm"]["with"]["rms"] < 1.5 * summary["repeatability_mm"]


def test_the_picture_is_sound_xml_and_shows_every_pose(result: Result) -> None:
    root = ElementTree.fromstring(svg_file(picture(result)))
    texts = [e.text for e in root.iter("{http://www.w3.org/2000/svg}text")]
    poses = len(np.unique(result.uncompensated.nominal_q, axis=0))
    assert sum(str(t).startswith("pose ") for t in texts) == poses
    bars = [
        e for e in root.iter("{http://www.w3.org/2000/svg}rect") if float(e.get("height", 0)) > 4
    ]
    assert len(bars) > 2 * poses


def test_the_page_needs_nothing_from_elsewhere(result: Result) -> None:
    text = page(result, "verdict: <explained>")
    assert "verdict: &lt;explained&gt;" in text
    assert "<script src" not in text
    assert text.count("<link") == text.count('<link rel="icon" href="data:,">')


def test_the_page_does_not_claim_a_tool_point_that_the_demo_leaves_out(result: Result) -> None:
    notes = (Note(Reason.TOOL_OFF_WRITTEN), Note(Reason.OUTLIERS, (3,)))
    text = page(replace(result, identification=replace(result.identification, notes=notes)), "")
    assert "3 outlier(s)" in text
    assert "written to the cell" not in text
    assert "Only the flexibilities of this fit are kept" in text


def test_bars_grow_with_their_share() -> None:
    lengths = [len(bar(share, 10)) for share in (0.0, 0.31, 0.5, 1.0, 7.0)]
    assert lengths == sorted(lengths)
    assert bar(1.0, 10) == "█" * 10
    assert bar(0.0, 10) != ""


FEW = "too few readings"
MISSED = "compensating -> holding (deadlines missed): 28 of 500 cycles missed"


class FastClock(Clock):
    """A clock whose sleeps return at once."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.monotonic = lambda: self.now
        self.sleep = self._sleep

    def _sleep(self, seconds: float) -> None:
        self.now += seconds


class SlowMachine(Session):
    """A machine that can keep only a quarter of the rate."""

    def __init__(self, kept: float, emit) -> None:
        super().__init__(None, Path(), emit, FastClock())
        self.rates: list[float] = []
        self.kept = kept

    def _run(self, cell, load, poses, longest):
        link = self._settings(cell).link
        self.rates.append(link.rate)
        return (
            RunOutcome(None, MISSED, False, Cause.OVERRUN)
            if link.rate > self.kept
            else RunOutcome(poses, "", False)
        )


class Scripted(Session):
    """A session whose runs end as scripted: visits done, cause, stall."""

    def __init__(self, *script: tuple[int, str, bool]) -> None:
        self.reported: list[str] = []
        super().__init__(None, Path(), self.reported.append, FastClock())
        self.script = list(script)
        self.requested: list[int] = []

    def _run(self, cell, load, poses, longest):
        self.requested.append(len(poses))
        done, cause, stalled = self.script.pop(0)
        zero = np.zeros((done, 6))
        found = Measurements(
            zero[:, 0], poses[:done], zero, zero[:, 0], zero[:, :3], zero, zero, zero
        )
        return RunOutcome(found if done else None, cause, stalled, cause, cause == FEW)


class FakeLink:
    """The parts of a DemoLink that Session.visit uses."""

    home = HOME

    def __init__(self) -> None:
        self.moves: list[np.ndarray] = []

    def declared(self, cell, load):
        return cell

    def prepare(self, folder, poses):
        return 1.0

    def bench(self):
        return self

    def attach(self, load): ...

    def move_to(self, q):
        self.moves.append(q)

    def close(self): ...


@pytest.mark.parametrize(("kept", "rates"), [(500, [500]), (125, [500, 250, 125])])
def test_a_machine_that_misses_deadlines_goes_on_at_a_lower_rate(kept, rates):
    cell = load_cell(Path(__file__).parents[3] / "config" / "ur10e_simulated.yaml")
    reported: list[str] = []
    session = SlowMachine(kept, reported.append)
    session._link = FakeLink()
    for expected in (rates, rates[-1:]):  # the second visit begins where the first ended
        session.rates.clear()
        assert len(session.visit(cell, TEST_LOADS[0], HOME[None])) == 1
        assert session.rates == expected
    assert len(reported) == len(rates) - 1


def test_a_machine_that_cannot_keep_a_fourth_of_the_rate_is_reported():
    cell = load_cell(Path(__file__).parents[3] / "config" / "ur10e_simulated.yaml")
    session = SlowMachine(50, lambda text: None)
    session._link = FakeLink()
    with pytest.raises(RunError, match="deadlines missed"):
        session.visit(cell, TEST_LOADS[0], HOME[None])


def five_visits(session: Scripted) -> Measurements:
    session._link = FakeLink()
    cell = load_cell(Path(__file__).parents[3] / "config" / "ur10e_simulated.yaml")
    return session.visit(cell, TEST_LOADS[0], HOME + np.arange(5)[:, None] * 0.1)


def test_a_run_that_a_stall_ended_goes_on_with_the_visits_that_are_left():
    session = Scripted((2, "state stale", False), (1, "?", True), (0, FEW, False), (2, "", False))
    found = five_visits(session)
    assert session.requested == [5, 3, 2, 2]
    np.testing.assert_array_equal(found.nominal_q[:, 0], HOME[0] + np.arange(5) * 0.1)
    assert [line.split(";")[1][:21] for line in session.reported] == [
        " 2 of 5 visits done, ", " 3 of 5 visits done, ", " 3 of 5 visits done, ",
    ]  # fmt: skip


def test_a_run_that_a_stall_ended_on_its_way_home_leaves_the_arm_there():
    session = Scripted((5, "state stale", False))
    assert len(five_visits(session)) == 5
    assert session._link.moves == [HOME]
    session = Scripted((5, "", False))
    assert len(five_visits(session)) == 5
    assert session._link.moves == []


def test_runs_that_come_no_farther_on_a_machine_that_keeps_time_are_a_failure():
    behind = Cause.SETPOINT_REFUSED
    session = Scripted((1, behind, False), *[(0, behind, False)] * 9)
    with pytest.raises(RunError, match="setpoint refused"):
        five_visits(session)
    assert session.requested == [5, 4, 4, 4, 4]
    session = Scripted((1, behind, False), *[(0, behind, True)] * 9, (4, "", False))
    assert len(five_visits(session)) == 5


@pytest.mark.parametrize("broke", ["offset saturated", "correction no number", "zero moved", ""])
def test_a_run_that_no_stall_ended_is_a_failure_at_once(broke):
    session = Scripted((5 if broke else 3, broke, False))
    with pytest.raises(RunError, match=broke or "before its last visit"):
        five_visits(session)
    assert session.requested == [5]


def named_cause(*parameters: tuple[str, float, float], effect: str = "tool_frame") -> NamedCause:
    return NamedCause(effect, tuple((name, value, std, "m") for name, value, std in parameters))


def bent(**shift: float) -> HiddenEffects:
    truth = {f"tool_frame_{axis}": value for axis, value in shift.items()}
    return HiddenEffects(("tool_frame",), "bent", truth, {"tool_shift": tuple(shift.values())})


def test_a_bent_tool_is_drawn_from_the_seed() -> None:
    drawn = [HiddenEffects.drawn(seed, ("bent_tool",)) for seed in range(20)]
    assert drawn[3] == HiddenEffects.drawn(3, ("bent_tool",)) != drawn[4]
    sizes = [np.linalg.norm(hidden.simulation["tool_shift"]) for hidden in drawn]
    assert 1e-3 <= min(sizes) <= max(sizes) <= 2.5e-3


def test_named_causes_are_compared_with_the_hidden_truth() -> None:
    hidden = bent(x=1e-3, y=0.0, z=-5e-4)
    right = named_cause(("tool_frame_x", 1.001e-3, 3e-6), ("tool_frame_z", -5.01e-4, 3e-6))
    bends = named_cause(effect="axial_compliance")
    assert hidden.mismatches([right, bends]) == []
    assert (
        "link_flexibility is named"
        in hidden.mismatches([right, named_cause(effect="link_flexibility")])[0]
    )
    assert "was not named" in hidden.mismatches([bends])[0]
    wrong = named_cause(("tool_frame_x", 1.2e-3, 3e-6))
    assert "tool_frame_x" in hidden.mismatches([wrong])[0]


def test_three_rounds_of_visits_and_the_truth_are_shown(
    result: Result, capsys: pytest.CaptureFixture[str]
) -> None:
    cause = named_cause(("tool_frame_x", 1.001e-3, 3e-6))
    whole = replace(
        result, explained=result.compensated, hidden=bent(x=1e-3, y=0.0, z=0.0), causes=(cause,)
    )
    show(whole, Console(width=140))
    said = capsys.readouterr().out
    assert "fit and diagnosis" in said
    assert "tool_frame_x: true +1 mm, estimated +1 ± 0.003 mm" in said
    drawn = svg_file(picture(whole))
    assert all(f'fill="var(--{c})"' in drawn for c in ("bad-dot", "before", "limit"))
    html = page(whole, "")
    assert "+1 ± 0.003 mm" in html
    assert whole.summary()["tcp_error_mm"]["fitted"]["rms"] > 0
    assert whole.summary()["hidden"]["tool_frame_x"] == 1e-3


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_nothing_of_the_report_is_cut_off_on_a_phone(result: Result, tmp_path: Path) -> None:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    whole = replace(
        result, explained=result.compensated, hidden=bent(x=1e-3, y=0.0, z=0.0),
        causes=(named_cause(("tool_frame_x", 1.001e-3, 3e-6)),),
    )  # fmt: skip
    path = tmp_path / "report.html"
    path.write_text(page(whole, "verdict: explained\n" + "x" * 100), encoding="utf-8")
    assert faults_on_a_phone(playwright, path) == []


def test_a_recording_without_states_is_a_run_to_be_repeated():
    found, missing = measurements_at({}, np.zeros((0, 7)), HOME[None])
    assert found is None
    assert "holds no state of the arm" in str(missing)
