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
from gapbridge.core.diagnosis.selection.refit import UnnamedPart, linearised_terms, refit, worth
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.diagnosis.selection.state import SelectionState, sample_space
from gapbridge.core.effects import Site, Term
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


@pytest.mark.slow
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


def test_a_direction_that_the_rows_hardly_determine_does_not_hold_up_the_others():
    """Its step is too long for the linearisation: it is shortened, not the whole step."""
    rng = np.random.default_rng(4)
    real = offset(2, LARGE_SAMPLE)
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    position = exact(real) + rng.normal(0, small.SIGMA, exact(real).shape)
    seen = observe(MODEL, small.log_of(SESSION, position), metrology)
    assert isinstance(seen, Observation)
    vague = rng.normal(size=seen.measured.shape)

    def predict(terms):
        size = sum(t.values[0] for t in terms if t.effect == "axial_compliance") / 1e-5
        shape = 1e-3 * size + max(abs(size) - 5.0, 0.0) ** 2
        others = [t for t in terms if t.effect != "axial_compliance"]
        return seen.predict(others) + small.SIGMA * vague * shape

    bent = replace(seen, predict=predict)
    wanted = [("joint_offset", 2), ("axial_compliance", 3)]
    candidates = [c for c in named_candidates(MODEL.arm, "position", turns=[1.0] * 3)
                  if (c.family, c.site.joint) in wanted]  # fmt: skip
    kept = np.ones(len(seen.rows), dtype=bool)
    noise = estimate_noise(bent, np.full(bent.measured.shape, small.FLOOR), kept)
    found = []
    for own in (candidates, [c for c in candidates if c.family == "joint_offset"]):
        state = SelectionState(bent, MODEL.arm, own, noise, kept)
        space, *_ = sample_space(state, [named_columns(bent, c, ()) for c in own], (), [])
        linear = fit(space, tuple(range(len(own))))
        start = tuple(np.full(1, 0.0599 if c.family == "joint_offset" else 0.0) for c in own)
        _, terms, _, _, _ = refit(state, space, replace(linear, values=start))
        found.append(next(t.values[0] for t in terms if t.effect == "joint_offset"))
    assert found[0] == pytest.approx(found[1], abs=1e-6)


@pytest.mark.parametrize("regions", [None, 5])
def test_a_fit_without_a_term_to_first_order_is_the_refit_without_it(regions):
    metrology = Metrology(registered=True, sigma=small.SIGMA)
    position = exact(offset(2, 1e-3))
    position = position + np.random.default_rng(5).normal(0, small.SIGMA, position.shape)
    seen = observe(MODEL, small.log_of(SESSION, position), metrology)
    assert isinstance(seen, Observation)
    wanted = [("joint_offset", 2), ("joint_offset", 3), ("axial_compliance", 3)]
    candidates = [c for c in named_candidates(MODEL.arm, "position", turns=[1.0] * 3)
                  if (c.family, c.site.joint) in wanted]  # fmt: skip
    kept = np.ones(len(seen.rows), dtype=bool)
    noise = estimate_noise(seen, np.full(seen.measured.shape, small.FLOOR), kept)
    state = SelectionState(seen, MODEL.arm, candidates, noise, kept)
    space, *_ = sample_space(state, [named_columns(seen, c, ()) for c in candidates], (), [])
    region = None
    if regions is not None:
        region = np.arange(seen.measured.size) * regions // seen.measured.size
    part = None if region is None else UnnamedPart(np.zeros((len(region), 0)), np.zeros(0), region)
    _, terms, _, _, _ = refit(state, space, fit(space, (0, 1, 2)), unnamed_part=part)
    found = linearised_terms(state, candidates, terms, [None] * 3, region, space.floor)
    for left in ((0, 2), (1,), (0, 1, 2)):
        _, exact_terms, _, covariance, _ = refit(state, space, fit(space, left), unnamed_part=part)
        values, spread = found.alone(left)
        for value, own, term, exactly in zip(values, spread, exact_terms, covariance, strict=True):
            assert abs(value[0] - term.values[0]) < 0.1 * np.sqrt(exactly[0, 0])
            assert own[0, 0] == pytest.approx(exactly[0, 0], rel=0.02)


@pytest.mark.parametrize(("velocity", "sigma", "counts"), [(10.0, 50.0, False), (0.1, 0.02, True)])
def test_friction_that_fades_at_no_speed_that_is_known_is_not_stribecks(velocity, sigma, counts):
    """A UR10's joint 2: 17.3 +- 0.9 Nm and 10 +- 50 rad/s, which is Coulomb friction."""
    term = Term("stribeck_friction", Site(2), (17.3, velocity))
    assert (worth(term, np.diag([0.9, sigma]) ** 2) > 1) == counts
