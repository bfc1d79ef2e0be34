"""Several sessions: frames and tool points of their own, effects shared, what changed is named.

The truth comes from the blind benchmark's mechanics. What is reported of a new session is compared
with what the model leaves of further sessions, placed by code of this file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small

from benchmarks.blind.mechanics import turn
from gapbridge.bridge.api.uncertainty import cause_entries
from gapbridge.bridge.cli.log.diagnosis_text import diagnosis_text
from gapbridge.bridge.document.diagnosis_json import document
from gapbridge.core.diagnosis.across_sessions import SessionTransfer, session_transfer
from gapbridge.core.diagnosis.channel_diagnosis import is_between_sessions, terms_with_stand_ins
from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.diagnosis import _log_findings, _slips, diagnose
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.effects import Site, Term
from gapbridge.core.errors import LogError
from gapbridge.core.estimation.held_out import pose_groups
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.rotation import rotation_matrix, rotation_vector
from gapbridge.core.sessions import join_sessions, session_of

MODEL = small.model_of()


def session(real, seed: int, poses: int = 40, remounted: bool = False):
    """Return a session's log in a frame of its own, with a target of its own if remounted."""
    rng = np.random.default_rng(seed + 7)
    moved = rng.normal(0, 0.02, 3) if remounted else np.zeros(3)
    drawn = small.session_of(seed, small.Plan(poses=poses))
    position = small.readings(replace(real, tool_position=small.TOOL + moved), drawn, seed)
    rotation = turn(rng.normal(0, 1, (1, 3)))[0]
    log = small.log_of(drawn, position @ rotation.T + rng.normal(0, 1, 3))
    return replace(log, path=f"{seed}.csv")


def together(real, seeds, **how):
    return join_sessions([session(real, s, **how) for s in seeds], MODEL)


def placed(model, log, tool: bool) -> np.ndarray:
    """Return the gap (N, 3) with the frame (and tool point) that fit the session best."""
    q, loads, measured = log.columns["actual_q"], log.loads(), log.columns["measured_position"]
    shift = np.zeros(3)
    for _ in range(30):
        at = model.tool_in_flange.copy()
        at[:3, 3] += shift
        poses = replace(model, tool_in_flange=at).predict(q, loads)
        cm, cp = measured.mean(0), poses.position.mean(0)
        U, _, V = np.linalg.svd((measured - cm).T @ (poses.position - cp))
        R = U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V
        gap = (measured - cm) @ R - (poses.position - cp)
        if not tool:
            return gap
        A = np.zeros((len(q), 3, 9))
        A[:, :, :3] = poses.rotation @ model.tool_in_flange[:3, :3].T
        A[:, :, 3:6] = np.eye(3)
        for k, e in enumerate(np.eye(3)):
            A[:, :, 6 + k] = np.cross(e, poses.position)
        step = np.linalg.lstsq(A.reshape(-1, 9), gap.ravel(), rcond=1e-12)[0]
        shift = shift + step[:3]
    return gap


def rms(values) -> float:
    return float(np.sqrt(np.mean(np.asarray(values) ** 2)))


@pytest.fixture(scope="module")
def compliant():
    log = together(small.REAL["axial_compliance"], (34, 35), remounted=True)
    return diagnose(MODEL, log, Metrology(sigma=small.SIGMA, remounted=True))


def test_a_cause_is_found_across_frames_and_tool_points(compliant) -> None:
    (channel,) = compliant.channels
    assert compliant.verdict == "explained"
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("axial_compliance", (2,))
    (parameter,) = cause.parameters
    assert abs(parameter.value - 4e-6) < 4 * parameter.std
    (across,) = channel.session_transfer
    assert across.transfers
    assert [s for s, _ in across.values] == [0, 1]


def test_what_is_reported_of_a_new_session_holds_for_further_ones(compliant) -> None:
    real = small.REAL["axial_compliance"]
    found = compliant.channels[0].generalisation
    further = [placed(compliant.model, session(real, s, remounted=True), True) for s in (44, 45)]
    assert 0.8 < found.new_session / rms(np.concatenate(further)) < 1.25
    assert [s for s, _ in found.by_session] == [0, 1]


@pytest.mark.slow
def test_figures_of_an_unknown_hold_in_a_new_session_too() -> None:
    real = small.REAL["cross_coupling"]
    found = diagnose(MODEL, together(real, (1, 2)), Metrology(sigma=small.SIGMA))
    (channel,) = found.channels
    assert not channel.causes
    further = [placed(found.model, session(real, s), False) for s in (11, 12, 13)]
    assert 0.8 < channel.generalisation.new_session / rms(np.concatenate(further)) < 1.25


def test_a_target_that_was_remounted_unsaid_is_no_noise() -> None:
    """The same logs as of the fixture, without the word that the target was taken off."""
    log = together(small.REAL["axial_compliance"], (34, 35), remounted=True)
    (channel,) = diagnose(MODEL, log, Metrology(sigma=small.SIGMA)).channels
    assert channel.generalisation.new_session > 20 * small.FLOOR or channel.structured


def test_a_value_that_changed_is_named_as_changed() -> None:
    logs = [session(small.soft(2, 4e-6), 34), session(small.soft(2, 8e-6), 35)]
    found = diagnose(MODEL, join_sessions(logs, MODEL), Metrology(sigma=small.SIGMA))
    (channel,) = found.channels
    (across,) = [c for c in channel.session_transfer if c.effect == "axial_compliance"]
    assert not across.transfers
    values = [p[0].value for _, p in across.values]
    assert values == pytest.approx([4e-6, 8e-6], rel=0.1)
    (cause,) = [
        c for c in document(found)["channels"][0]["causes"] if c["effect"] == "axial_compliance"
    ]
    assert cause["across_sessions"]["carries"] is False
    assert [v["session"] for v in cause["across_sessions"]["values"]] == ["34.csv", "35.csv"]


@pytest.mark.slow
def test_what_holds_in_one_session_only_depends_on_the_session() -> None:
    """Nothing of the catalogue: two sessions of three bend by the square of another joint."""
    real = small.REAL["cross_coupling"]
    deflected = replace(real, angle_errors=(lambda s: 3 * real.angle_errors[0](s),))
    logs = [session(deflected, 1), session(small.NOMINAL, 2), session(deflected, 3)]
    found = diagnose(MODEL, join_sessions(logs, MODEL), Metrology(sigma=small.SIGMA))
    assert "session" in found.channels[0].selection.observation.quantities
    assert found.channels[0].structured


def test_one_session_has_no_figure_for_a_new_one() -> None:
    found = small.diagnosed("axial_compliance").channels[0].generalisation
    assert found.new_session is None
    assert found.by_session == ()
    assert found.new_region is not None
    assert 0.8 * small.FLOOR < found.new_region < 1.3 * small.FLOOR


def test_a_pose_that_sessions_repeat_is_one_condition() -> None:
    """Held out in one session and fitted in another, the pose would have been seen."""
    drawn, rng = small.session_of(3, small.Plan(poses=14)), np.random.default_rng(0)
    there = small.readings(small.NOMINAL, drawn)
    logs = [
        replace(small.log_of(drawn, there + rng.normal(0, 1e-5, there.shape)), path=f"{s}.csv")
        for s in range(3)
    ]
    log = join_sessions(logs, MODEL)
    seen = observe(MODEL, log, Metrology())
    assert isinstance(seen, Observation)
    moved = seen.rebased(np.full(seen.nuisance.shape[2], 1e-6), ())
    conditions = pose_groups(log.columns["actual_q"])
    assert len(set(conditions)) == 14 < len(log)
    for observation in (seen, moved):
        np.testing.assert_array_equal(observation.groups, conditions)


def test_a_session_too_short_for_its_frame_is_refused() -> None:
    logs = [session(small.NOMINAL, 1), session(small.NOMINAL, 2).select(slice(0, 2))]
    log = join_sessions(logs, MODEL)
    for state in (diagnose, identify_compliance):
        with pytest.raises(LogError, match=r"session 2\.csv: found 2 measured pose\(s\), expected"):
            state(MODEL, log, Metrology(sigma=small.SIGMA))


def test_a_fit_of_sessions_shares_the_flexibilities() -> None:
    real = replace(small.NOMINAL, axial=np.array(small.KIND.axial))
    for remounted in (False, True):
        log = together(real, (1, 2, 3), remounted=remounted)
        found = identify_compliance(MODEL, log, Metrology(sigma=small.SIGMA, remounted=remounted))
        off = np.abs(found.axial - small.KIND.axial) / found.std_axial
        assert off.max() < 4
        fitted = MODEL.with_compliance(found.axial, found.radial)
        further = session(real, 11, remounted=remounted)
        true = rms(placed(fitted, further, remounted))
        assert 0.8 < found.remaining_rms_new_session / true < 1.25
        assert 0.8 * small.FLOOR < found.remaining_rms_new_region < 1.4 * small.FLOOR
    one = identify_compliance(MODEL, session(real, 1), Metrology(sigma=small.SIGMA))
    assert np.isnan(one.remaining_rms_new_session)


def test_a_parameter_that_one_session_does_not_show_is_not_compared() -> None:
    """The second session's rows have a column of zeros for one of the two joints."""
    logs = [session(small.soft(2, 4e-6), 34), session(small.soft(2, 4e-6), 35)]
    found = diagnose(MODEL, join_sessions(logs, MODEL), Metrology(sigma=small.SIGMA))
    selection = found.channels[0].selection
    (own,) = selection.best.chosen
    rows = np.repeat(selection.observation.session[selection.kept], 3)
    X = selection.space.X.copy()
    other = own - 1 if own else own + 1
    column = selection.space.start[other]
    X[:, column] = np.where(rows == 0, X[:, column] + 1e-3, 0.0)
    coefficients = selection.unprojected.coefficients.copy()
    coefficients[:, column] = 0.0
    changed = replace(
        selection, space=replace(selection.space, X=X),
        unprojected=replace(selection.unprojected, coefficients=coefficients),
    )  # fmt: skip
    reported = session_transfer(changed, (own, other), MODEL.arm)
    assert all(np.isfinite(c.p_value) for c in reported)
    assert "axial_compliance" in {c.effect for c in reported}


def sessions_with_slip() -> Log:
    """Return three sessions, each from time 0; joint 2 slips before the second."""
    off = small.turned(2, lambda s, q: np.full(len(q), 3e-3))
    logs = [session(real, seed) for seed, real in ((34, small.NOMINAL), (35, off), (36, off))]
    return join_sessions(logs, MODEL)


@pytest.fixture(scope="module")
def slipped():
    """Return the diagnosis of sessions with a slip."""
    return diagnose(MODEL, sessions_with_slip(), Metrology(sigma=small.SIGMA))


@pytest.mark.parametrize("carried", [True, False])
def test_a_slip_is_not_all_that_changed_where_a_cause_differs_between_sessions(slipped, carried):
    (channel,) = slipped.channels
    other = SessionTransfer("axial_compliance", carried, 1e-9, ())
    changed = replace(channel, session_transfer=(*channel.session_transfer, other))
    (slip,) = _slips(changed, channel.causes[0].terms, sessions_with_slip())
    assert slip.alone is carried
    assert (slip.others, slip.session, slip.between_sessions) == (0, "35.csv", True)


def test_a_moment_inside_a_session_is_between_none() -> None:
    log = sessions_with_slip()
    session, times = session_of(log), log.times()
    middle, end = (f(times[session == 1]) for f in (np.median, np.max))
    assert [is_between_sessions(t, log) for t in (times[0] - 1, middle, end, times[-1])] == [
        False, False, True, False,
    ]  # fmt: skip


def test_where_clocks_overlap_a_step_is_told_by_the_first_session_that_has_it(slipped) -> None:
    """A time of the joined clock would be none of any session's."""
    (channel,) = slipped.channels
    (cause,) = channel.causes
    assert cause.effect == "joint_slip"
    expected = [("joint_slip_2_time", None, "s"), ("joint_slip_2_session", "35.csv", "")]
    (in_json,) = document(slipped)["channels"][0]["causes"]
    (in_cell,) = cause_entries(slipped)
    assert in_json["parameters"] == in_cell["parameters"]
    assert [(p["name"], p["value"], p["unit"]) for p in in_json["parameters"][1:]] == expected
    text = diagnosis_text(slipped)
    assert "joint_slip_2_session = 35.csv" in text
    assert "35.csv is the first session that has it" in text
    assert "joint_slip_2_time" not in text
    (term,) = slipped.model.terms
    assert term.values[-1] < session(small.NOMINAL, 34).times()[0]  # all rows have it


def test_rows_without_times_are_numbered_in_each_file() -> None:
    """A number of the joined rows would be that of another row where one file stands alone."""
    off = small.turned(2, lambda s, q: np.full(len(q), 3e-3))
    logs = [session(real, seed) for seed, real in ((34, small.NOMINAL), (35, off))]
    untimed = [
        replace(log, columns={k: v for k, v in log.columns.items() if k != "timestamp"})
        for log in logs
    ]
    joined = join_sessions(untimed, MODEL)
    found = diagnose(MODEL, joined, Metrology(sigma=small.SIGMA))
    (cause,) = document(found)["channels"][0]["causes"]
    told = [(p["name"], p["value"]) for p in cause["parameters"][1:]]
    assert told == [("joint_slip_2_time", None), ("joint_slip_2_session", "35.csv")]
    assert "rows" not in diagnosis_text(found) and "timestamps overlap" not in diagnosis_text(found)
    (term,) = found.model.terms
    assert term.values[-1] < untimed[1].times()[0]  # all rows of the second file have it


def test_the_model_with_stand_ins_has_the_final_causes_and_applies_steps_everywhere(slipped):
    """The common fit is made before all rows withdraw some of its terms."""
    (channel,) = slipped.channels
    log = join_sessions([session(small.NOMINAL, s) for s in (34, 35)], MODEL)
    (slip,) = channel.causes[0].terms
    gone = Term("backlash", Site(1), (1e-4,))
    fitted = replace(channel, fitted_together=(slip, gone))
    (kept,) = terms_with_stand_ins([fitted], log)
    assert kept.effect == "joint_slip"
    assert kept.values[-1] < log.times()[0]


@pytest.mark.parametrize(
    ("turned", "remounted", "hinted"),
    [((0.0, 0.3), False, True), ((0.3, 0.3), False, False), ((0.0, 0.3), True, False)],
)
def test_a_target_whose_axes_change_between_sessions_may_be_remounted(
    turned: tuple[float, ...], remounted: bool, hinted: bool
) -> None:
    logs = []
    for s, angle in enumerate(turned):
        drawn = small.session_of(s, small.Plan(poses=20))
        log = small.log_of(drawn, drawn.q)  # the positions follow
        poses = MODEL.predict(log.columns["actual_q"], log.loads())
        target = poses.rotation @ rotation_matrix(np.array([[0.0, 0.0, angle]]))[0]
        columns = {
            "measured_position": poses.position,
            "measured_rotation": rotation_vector(target),
        }
        logs.append(replace(log, columns=log.columns | columns, path=f"{s}.csv"))
    metrology = Metrology(registered=True, sigma=small.SIGMA, remounted=remounted)
    found = _log_findings(MODEL, join_sessions(logs, MODEL), metrology)
    assert (LogFinding(LogCheck.TARGET_REMOUNTED) in found) == hinted
