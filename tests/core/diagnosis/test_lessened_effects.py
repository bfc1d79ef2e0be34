"""An effect that the cell holds and that has become smaller, or is gone, is accused as such."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.channel_diagnosis import with_causes
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.selection.candidate import named_candidates
from gapbridge.core.diagnosis.selection.refit import with_free_shape
from gapbridge.core.diagnosis.selection.rounds import bounded, payload_bounds
from gapbridge.core.effects import CATALOGUE, Site, Term, totals
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

ARM = builtin_arm("ur10e")
MODEL = Model(ARM).with_compliance(np.full(6, 8e-6), np.full(6, 4e-6))
NOISE = 2e-5  # m


def play(rad):
    return Term("backlash", Site(2), (rad,))


def friction(torque):
    return Term("coulomb_friction", Site(2), (torque,))


def diagnosed_poses(cell, truth, seed=1):
    rng = np.random.default_rng(seed)
    q, approach = rng.uniform(-2, 2, (60, 6)), rng.choice([-1.0, 1.0], (60, 6))
    mass = rng.uniform(2, 8, 60)
    position = MODEL.with_terms(truth).predict(q, Loads(payload_mass=mass, approach=approach))
    measured = position.position + rng.normal(size=(60, 3)) * NOISE
    columns = {"actual_q": q, "approach": approach, "payload": mass, "measured_position": measured}
    return diagnose(MODEL.with_terms(cell), Log("log", columns, 6), Metrology(registered=True))


@pytest.mark.parametrize("seed", range(4))  # some of them on the bound
@pytest.mark.parametrize(("held", "left"), [((1e-3,), 2e-4), ((6e-4, 4e-4), 2e-4), ((1e-3,), 0.0)])
def test_play_that_is_less_or_gone_is_accused(held, left, seed):
    found = diagnosed_poses([play(v) for v in held], [play(left)], seed)
    (cause,) = found.channels[0].causes
    assert cause.effect == "backlash"
    assert cause.terms[0].values[0] == pytest.approx(left - sum(held), abs=1e-4)
    assert cause.terms[0].values[0] >= -sum(held)
    kept = [t for t in found.model.terms if t.effect == "backlash"]
    assert len(kept) <= 1  # --apply writes the total
    assert sum(t.values[0] for t in kept) == pytest.approx(left, abs=1e-4)
    assert all(t.values[0] > 0 for t in kept)


@pytest.mark.parametrize("seed", range(6))  # one of them on the bound
def test_a_declared_load_that_is_not_there_is_accused(seed):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-2, 2, (60, 6))
    measured = MODEL.predict(q).position + rng.normal(size=(60, 3)) * NOISE
    columns = {"actual_q": q, "payload": np.full(60, 5.0), "measured_position": measured}
    found = diagnose(MODEL, Log("log", columns, 6), Metrology(registered=True))
    (cause,) = found.channels[0].causes
    assert cause.effect == "payload"
    assert cause.terms[0].values[0] == pytest.approx(-5.0, abs=0.1)


def recording(truth, seed=0):
    """Return a recording of torques (and of encoders behind their commands)."""
    from gapbridge.core.dynamics import predict_torque, predict_tracking
    from gapbridge.core.motion import motion_of

    rng, time = np.random.default_rng(seed), np.arange(1500) * 0.008
    q = np.tile([0, -1.2, 1.4, -1.7, -1.5, 0], (len(time), 1))
    for joint in range(6):
        for _ in range(4):
            rate, phase = rng.uniform(0.05, 0.6), rng.uniform(0, 6)
            q[:, joint] += rng.uniform(0.1, 0.35) * np.sin(2 * np.pi * rate * time + phase)
    columns = {"timestamp": time, "actual_q": q}
    model = Model(ARM, terms=tuple(truth))
    if any("torque" in CATALOGUE[t.effect].channels for t in truth):
        torque = predict_torque(model, motion_of(Log("log", columns, 6)))
        columns["actual_current_as_torque"] = torque + rng.normal(size=torque.shape) * 0.3
    else:
        columns["target_q"] = q
        actual = predict_tracking(model, motion_of(Log("log", columns, 6)))
        columns["actual_q"] = actual + rng.normal(size=q.shape) * 1e-5
    return Log("log", columns, 6)


def test_friction_that_has_fallen_is_accused():
    found = diagnose(Model(ARM, terms=(friction(8.0),)), recording([friction(4.0)]))
    (cause,) = next(c for c in found.channels if c.channel == "torque").causes
    assert cause.effect == "coulomb_friction"
    assert cause.terms[0].values[0] == pytest.approx(-4.0, abs=0.1)
    assert found.model.terms[0].values[0] == pytest.approx(4.0, abs=0.1)


def test_a_lag_that_has_become_shorter_is_accused_at_its_value():
    lags = [[Term("tracking_lag", Site(i + 1), (v,)) for i in range(6)] for v in (0.05, 0.02)]
    found = diagnose(Model(ARM, terms=tuple(lags[0])), recording(lags[1]))
    (cause,) = next(c for c in found.channels if c.channel == "tracking").causes
    assert cause.effect == "tracking_lag"
    assert [t.values[0] for t in found.model.terms] == pytest.approx([0.02] * 6, abs=1e-3)


def candidate_of(family, model, joint=2):
    candidates = named_candidates(ARM, CATALOGUE[family].channels[0], turns=[1.0] * 6)
    found = next(c for c in candidates if c.family == family and c.site.joint in (joint, None))
    return bounded(found, model, None)


@pytest.mark.parametrize("family", [e for e, effect in CATALOGUE.items() if effect.adds_up])
def test_the_bound_of_what_adds_up_is_that_of_the_total(family):
    effect = CATALOGUE[family]
    site = next(s for s in effect.sites(ARM) if s.joint in (2, None))
    parameters = effect.parameters(ARM, site)
    assert all(p.lower == 0 for p in parameters)
    held = Term(family, site, tuple(3 * p.scale for p in parameters))
    whole = with_free_shape(ARM, candidate_of(family, Model(ARM, terms=(held, held)))).parameters
    assert [p.lower for p in whole] == pytest.approx([-6 * p.scale for p in parameters])
    assert [p.upper for p in whole] == pytest.approx([p.upper - 6 * p.scale for p in parameters])


def test_no_other_effect_is_bounded_by_what_the_model_holds():
    for family in ("joint_offset", "torque_constant", "stribeck_friction"):
        site = Site(2)
        values = tuple(p.scale for p in CATALOGUE[family].parameters(ARM, site))
        with_term, without = (
            candidate_of(family, Model(ARM, terms=terms))
            for terms in ((Term(family, site, values),), ())
        )
        assert with_term.parameters == without.parameters


@pytest.mark.parametrize(("added", "least"), [(0.0, -2.0), (1.0, -3.0), (-1.0, -1.0), (-3.0, 0.0)])
def test_the_least_load_counts_the_one_that_the_cell_adds(added, least):
    class Seen:
        payload_mass = np.array([2.0, 3.0])

    model = MODEL.with_terms([Term("payload", Site(), (added,))])
    assert payload_bounds(model, Seen)[0] == pytest.approx(least)


def test_totals_are_written_and_zeros_left_out():
    other = Term("joint_offset", Site(1), (1e-3,))
    assert totals([friction(8.0), other, other, friction(-8.0)]) == (other, other)
    assert totals([friction(8.0), friction(-3.0)]) == (friction(5.0),)
    assert with_causes(Model(ARM, terms=(friction(8.0),)), [friction(-8.0)]).terms == ()


def test_a_curve_with_a_negative_slope_takes_over_the_flexibility_it_softens():
    curve = Term("stiffness_nonlinearity", Site(2), (-2e-6, 1e-6))
    model = MODEL.with_terms([curve])
    whole = with_causes(MODEL, [curve])
    (written,) = [t for t in whole.terms if t.effect == curve.effect]
    assert written.values == pytest.approx((6e-6, 1e-6))
    q = np.random.default_rng(0).uniform(-2, 2, (5, 6))
    assert whole.predict(q).position == pytest.approx(model.predict(q).position, abs=1e-12)
