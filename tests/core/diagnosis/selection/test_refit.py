"""The exact refit: finite rotations, frames and all, whatever the linear start was off by."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import small_arm as small
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.blind.mechanics import RealArm, turn
from gapbridge.core.diagnosis.channels.position import observe
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import named_candidates, named_columns
from gapbridge.core.diagnosis.selection.noise import estimate_noise
from gapbridge.core.diagnosis.selection.refit import refit
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.diagnosis.selection.state import SelectionState, sample_space
from gapbridge.core.metrology import Metrology

MODEL = small.model_of()
SESSION = small.session_of(0)
LARGE_SAMPLE = 0.06  # rad: its square times the reach is a millimetre


def refitted(position, effects, registered=True, left=None, start=None):
    """Return the terms, deviations and residual of a refit of these effects (effect, joint).

    ``start`` are values to begin from instead of the linear ones.
    """
    metrology = Metrology(registered=registered, sigma=small.SIGMA)
    seen = observe(MODEL, small.log_of(SESSION, position), metrology)
    assert isinstance(seen, Observation)
    wanted = [c for c in named_candidates(MODEL.arm, "position", turns=[1.0] * 3)
              if (c.family, c.site.joint) in effects]  # fmt: skip
    kept = np.ones(len(seen.rows), dtype=bool)
    left = np.full(seen.measured.shape, small.FLOOR) if left is None else left
    noise = estimate_noise(seen, left, kept)
    state = SelectionState(seen, MODEL.arm, wanted, noise, kept)
    columns = [named_columns(seen, c, ()) for c in wanted]
    space, *_ = sample_space(state, columns, (), [])
    found = fit(space, tuple(range(len(wanted))))
    begin = found if start is None else replace(found, values=start)
    _, terms, _, covariance, residual = refit(state, space, begin)
    spread = [np.sqrt(np.diag(c)) for c in covariance]
    return found, terms, spread, residual


def exact(real: RealArm, frame=None):
    """Return noise-free positions, in the frame of an instrument that stands elsewhere or not."""
    position = small.stand(real, SESSION).tcp
    return position if frame is None else position @ frame[0].T + frame[1]


def offset(joint: int, angle: float) -> RealArm:
    return small.turned(joint, lambda s, q: np.full(len(q), angle))


@settings(max_examples=10, deadline=None)
@given(angle=st.floats(-0.15, 0.15), joint=st.integers(1, 3))
def test_a_large_offset_is_found_exactly_where_a_line_is_far_off(angle, joint):
    found, (term,), _, residual = refitted(exact(offset(joint, angle)), [("joint_offset", joint)])
    assert term.values[0] == pytest.approx(angle, abs=1e-9)
    assert np.abs(residual).max() < 1e-9
    if abs(angle) > 0.02:
        assert abs(found.values[0][0] - angle) > 1e-6  # the line alone


def test_a_flexibility_is_refitted_from_nominal_if_its_linear_value_has_no_equilibrium():
    soft = replace(small.NOMINAL, axial=np.array([0.0, 2e-5, 0.0]))
    start = (np.array([0.1]),)  # rad/Nm: the arm would turn over
    _, (term,), _, residual = refitted(exact(soft), [("axial_compliance", 2)], start=start)
    assert term.values[0] == pytest.approx(2e-5, rel=1e-6)
    assert np.abs(residual).max() < 1e-9


def test_effects_that_meet_in_one_joint_are_refitted_together():
    real = replace(
        offset(2, LARGE_SAMPLE), axial=np.array([0.0, 2e-5, 0.0]),
        tool_position=small.TOOL + np.array([2e-3, -1e-3, 3e-3]),
    )  # fmt: skip
    effects = [("joint_offset", 2), ("axial_compliance", 2), ("tool_frame", None)]
    _, terms, _, residual = refitted(exact(real), effects)
    values = {t.effect: t.values for t in terms}
    assert values["joint_offset"][0] == pytest.approx(LARGE_SAMPLE, abs=1e-8)
    assert values["axial_compliance"][0] == pytest.approx(2e-5, rel=1e-5)
    assert np.allclose(values["tool_frame"][:3], [2e-3, -1e-3, 3e-3], atol=1e-8)
    assert np.abs(residual).max() < 1e-8


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 999))
def test_the_instruments_pose_changes_nothing(seed):
    rng = np.random.default_rng(seed)
    frame = turn(rng.normal(0, 1.5, (1, 3)))[0], rng.uniform(-5, 5, 3)
    _, (term,), _, residual = refitted(
        exact(offset(2, LARGE_SAMPLE), frame), [("joint_offset", 2)], registered=False
    )
    assert term.values[0] == pytest.approx(LARGE_SAMPLE, abs=1e-7)
    assert np.abs(residual).max() < 1e-7


def test_the_reported_deviation_is_the_scatter_over_sessions():
    real = replace(offset(2, 0.01), axial=np.array([0.0, 5e-6, 0.0]))
    effects = [("joint_offset", 2), ("axial_compliance", 2)]
    scores = []
    for seed in range(30):
        read = small.readings(real, SESSION, seed)
        _, terms, spread, _ = refitted(read, effects, left=read - exact(real))
        true = {"joint_offset": 0.01, "axial_compliance": 5e-6}
        scores += [
            (t.values[0] - true[t.effect]) / s[0] for t, s in zip(terms, spread, strict=True)
        ]
    assert np.abs(scores).max() < 4.5
    assert 0.6 < np.sqrt(np.mean(np.square(scores))) < 1.4


def test_a_parameter_that_cannot_be_negative_is_kept_on_its_bound():
    ahead = small.turned(2, lambda s, q: 2e-4 * s.approach[:, 1])  # play the wrong way round
    _, (term,), _, _ = refitted(exact(ahead), [("backlash", 2)])
    assert term.values[0] == 0.0
    behind = small.turned(2, lambda s, q: -2e-4 * s.approach[:, 1])
    _, (term,), _, _ = refitted(exact(behind), [("backlash", 2)])
    assert term.values[0] == pytest.approx(4e-4, abs=1e-8)


def test_a_number_that_moves_nothing_hides_no_other():
    """A term whose column is rounding alone (a torque scaled that is not there) stays vague."""
    wanted = [("joint_offset", 2), ("axial_compliance", 3)]
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    seen = observe(MODEL, small.log_of(SESSION, exact(offset(2, 0.01))), metrology)
    assert isinstance(seen, Observation)

    nominal = seen.predict(())

    def predict(terms):
        dead = sum(t.values[0] for t in terms if t.effect == "axial_compliance")
        others = [t for t in terms if t.effect != "axial_compliance"]
        return seen.predict(others) - nominal + 1e-15 * dead / 1e-5

    deaf = replace(seen, measured=seen.measured - nominal, predict=predict)
    candidates = [c for c in named_candidates(MODEL.arm, "position", turns=[1.0] * 3)
                  if (c.family, c.site.joint) in wanted]  # fmt: skip
    kept = np.ones(len(seen.rows), dtype=bool)
    noise = estimate_noise(deaf, np.full(deaf.measured.shape, small.FLOOR), kept)
    state = SelectionState(deaf, MODEL.arm, candidates, noise, kept)
    columns = [named_columns(deaf, c, ()) for c in candidates]
    space, *_ = sample_space(state, columns, (), [])
    alone = [c.family for c in candidates].index("joint_offset")
    _, _, _, (expected,), _ = refit(state, space, fit(space, (alone,)))
    _, terms, _, covariance, _ = refit(state, space, fit(space, (0, 1)))
    assert terms[alone].values[0] == pytest.approx(0.01, abs=1e-6)
    assert covariance[alone][0, 0] == pytest.approx(expected[0, 0], rel=0.05)
