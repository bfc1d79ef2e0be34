"""The torque channel on Pinocchio's torques: each effect is recovered, with the right sign."""

from __future__ import annotations

import time

import moving_truth as truth
import numpy as np
import pinocchio as pin
import pytest
from further import further

from gapbridge.core import dynamics
from gapbridge.core.diagnosis import channel_search
from gapbridge.core.diagnosis.channels.recording import STRETCHES
from gapbridge.core.diagnosis.channels.torque import observe
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.diagnosis.regions import regions
from gapbridge.core.diagnosis.selection.candidate import jacobian, named_candidates
from gapbridge.core.diagnosis.thinning import thinned
from gapbridge.core.effects import Site, Term
from gapbridge.core.metrology import Metrology
from gapbridge.core.sessions import with_sessions

METROLOGY = Metrology()
N = 6
COURSE = truth.course(N, 2)
NOISE = 0.2  # Nm
FRICTION = np.array([8, 9, 6, 3, 2, 1.5])


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    return truth.plant(tmp_path_factory.mktemp("arm"), N, 1)


@pytest.fixture(scope="module")
def recorded(plant):
    t = np.arange(5000) / 250
    q, qd, qdd = (COURSE.at(t, order) for order in (0, 1, 2))
    return t, q, qd, qdd, plant.dynamics(q, qd, qdd, payload=2.0)[0]


def log_of(recorded, torque, seed=0, **more):
    t, q, qd, *_ = recorded
    rng = np.random.default_rng(seed)
    return truth.log_of(
        N, timestamp=t, actual_q=np.round(q / 1.2e-5) * 1.2e-5,
        actual_qd=qd + rng.normal(0, 1e-3, qd.shape),
        actual_current_as_torque=torque + rng.normal(0, NOISE, torque.shape), **more,
    )  # fmt: skip


def silent(recorded):
    t, q, qd, *_ = recorded
    return truth.log_of(N, timestamp=t, actual_q=q, actual_qd=qd, actual_current_as_torque=0 * q)


def term(effect, joint=None):
    return Term(effect, Site(joint), (0.0,))


CASES = {
    "coulomb_friction": (3, 6.0),
    "viscous_friction": (3, 3.0),
    "rotor_inertia": (4, 0.3),
    "link_inertia": (3, 0.1),
    "torque_constant": (2, 0.04),
    "payload": (None, 0.7),
}


def torque_with(plant, recorded, effect, joint, value):
    _, q, qd, qdd, nominal = recorded
    here = np.arange(N) == (joint or 0) - 1
    if effect == "payload":
        return plant.dynamics(q, qd, qdd, payload=2.0 + value)[0]
    if effect == "link_inertia":
        return plant.dynamics(q, qd, qdd, payload=2.0, link=joint, more=value)[0]
    if effect == "torque_constant":
        return nominal * (1 + value * here)
    along = {"coulomb_friction": np.sign(qd), "viscous_friction": qd, "rotor_inertia": qdd}
    return nominal + value * here * along[effect]


@pytest.mark.parametrize("effect", CASES)
def test_an_effect_is_recovered_and_leaves_the_noise_alone(plant, recorded, effect):
    joint, value = CASES[effect]
    log = log_of(recorded, torque_with(plant, recorded, effect, joint, value))
    seen = observe(plant.model(2.0), log, METROLOGY)
    (found,), spread = truth.fit(plant.arm, seen, [term(effect, joint)])
    assert abs(found.values[0] - value) < 3.5 * spread[0]
    assert spread[0] < 0.1 * abs(value)
    residual = (seen.measured - seen.predict([found])).std()
    assert residual == pytest.approx(NOISE, rel=0.05)


def test_many_effects_together_are_recovered(plant, recorded):
    _, q, qd, qdd, _ = recorded
    torque = plant.dynamics(q, qd, qdd, payload=2.5)[0] + FRICTION * np.sign(qd) + 2.0 * qd
    torque[:, 1] *= 1.03
    log = log_of(recorded, torque)
    terms = [term("coulomb_friction", j + 1) for j in range(N)]
    terms += [term("viscous_friction", j + 1) for j in range(N)]
    terms += [term("payload"), term("torque_constant", 2)]
    seen = observe(plant.model(2.0), log, METROLOGY)
    found, spread = truth.fit(plant.arm, seen, terms)
    values = np.concatenate([t.values for t in found])
    expected = np.concatenate([FRICTION, np.full(N, 2.0), [0.5, 0.03]])
    assert np.abs((values - expected) / spread).max() < 4


@pytest.mark.parametrize("without", ["", "load_friction"])
def test_derivatives_are_those_among_all_other_terms(plant, recorded, without):
    """Terms that cancel in a difference are left out, no others: loads and gains count."""
    seen = observe(plant.model(2.0), log_of(recorded, recorded[4]), METROLOGY)
    seen = seen.subset(np.arange(0, len(seen.rows), 40))
    rng = np.random.default_rng(3)
    candidates = [c for c in named_candidates(plant.arm, "torque") if c.family != without]
    x = [rng.uniform(0.5, 1.5, len(c.scales)) * c.scales for c in candidates]
    terms = [c.term(v) for c, v in zip(candidates, x, strict=True)]
    for i, (candidate, value) in enumerate(zip(candidates, x, strict=True)):
        others = terms[:i] + terms[i + 1 :]
        columns = jacobian(seen, candidate, value, others)
        for k, scale in enumerate(candidate.scales):
            step = 1e-2 * scale * (np.arange(len(value)) == k)
            ahead = seen.predict([*others, candidate.term(value + step)])
            behind = seen.predict([*others, candidate.term(value - step)])
            slope = (ahead - behind) / (2 * step[k])
            assert np.abs(columns[..., k] - slope).max() < 1e-5 * np.abs(slope).max() + 1e-9


def test_a_clean_log_leaves_the_noise(plant, recorded):
    seen = observe(plant.model(2.0), log_of(recorded, recorded[4]), METROLOGY)
    residual = seen.measured - seen.predict(())
    assert residual.std() == pytest.approx(NOISE, rel=0.03)
    assert np.abs(residual.mean(axis=0)).max() < 0.02


def test_poses_at_rest_are_observed_without_friction(plant):
    q = truth.poses(N, 40, 3)
    torque, _ = plant.dynamics(q, 0 * q, 0 * q, payload=2.6)
    noisy = torque + np.random.default_rng(0).normal(0, 0.05, torque.shape)
    log = truth.log_of(N, actual_q=q, actual_current_as_torque=noisy)
    seen = observe(plant.model(2.0), log, METROLOGY)
    (found,), spread = truth.fit(plant.arm, seen, [term("payload")])
    assert abs(found.values[0] - 0.6) < 3.5 * spread[0]
    assert len(np.unique(seen.groups)) == 40
    assert not seen.order_in_time
    friction = term("coulomb_friction", 2).with_values(np.array([1.0]))
    assert np.array_equal(seen.predict([friction]), seen.predict(()))


def test_an_outside_pull_is_no_gap(plant):
    q = truth.poses(N, 40, 3)
    pull = np.random.default_rng(1).uniform(-30, 30, (40, 6))
    torque, _ = plant.dynamics(q, 0 * q, 0 * q, pull=pull, payload=2.0)
    log = truth.log_of(N, actual_q=q, actual_current_as_torque=torque, actual_TCP_force=pull)
    seen = observe(plant.model(2.0), log, METROLOGY)
    assert np.abs(seen.measured - seen.predict(())).max() < 1e-8


def test_effects_of_a_short_recording_have_to_gain_by_themselves_too(plant, recorded, monkeypatch):
    """Of up to 300 samples, all searched, first moments came with what the friction gained."""
    judged = []

    def accused(selection, judgement, *rest):
        judged.append(judgement.accused)
        return kept(selection, judgement, *rest)

    kept = channel_search.accused_on_all_rows
    monkeypatch.setattr(channel_search, "accused_on_all_rows", accused)
    wrong = plant.model(2.0).with_terms(
        [Term("link_cog", Site(j), (0.4, -0.3, 0.2)) for j in (2, 3, 4)]
    )
    torque = recorded[-1] + FRICTION * (np.sign(recorded[2]) + recorded[2])
    log = log_of(recorded, torque).select(slice(0, 5000, 20))
    (channel,) = diagnose(wrong, log).channels
    assert channel.samples <= 300
    assert [len(names) > 0 for names in judged] == [True]
    assert "coulomb_friction" in {cause.effect for cause in channel.causes}
    assert all(cause.shrink.interval[0] > 0 for cause in channel.causes)


def test_rows_at_a_reversal_are_left_out(plant, recorded):
    seen = observe(plant.model(2.0), log_of(recorded, recorded[4]), METROLOGY)
    speed = np.abs(recorded[2][seen.rows])
    assert speed.min() > 1e-3


def test_joints_that_move_one_at_a_time_keep_their_rows(plant):
    t = np.arange(6000) / 250
    wave = np.sin(2 * np.pi * 0.5 * t) ** 3 * 0.4
    turn = (t // 4).astype(int) % N
    q = np.where(turn[:, None] == np.arange(N), wave[:, None], 0.0)
    log = truth.log_of(N, timestamp=t, actual_q=q, actual_current_as_torque=q)
    seen = observe(plant.model(2.0), log, METROLOGY)
    assert len(seen.rows) > 2000


def test_a_long_log_is_used_whole_and_held_out_by_stretches_of_time(plant):
    t = np.arange(15000) / 500
    log = truth.log_of(N, timestamp=t, actual_q=COURSE.at(t),
                       actual_current_as_torque=COURSE.at(t),
                       joint_temperatures=np.tile(t[:, None], N) + 20)  # fmt: skip
    begin = time.process_time()  # what the machine does beside it costs no time of this process
    seen = observe(plant.model(2.0), log, METROLOGY)
    assert time.process_time() - begin < 3
    assert isinstance(seen, Observation)
    assert len(seen.measured) == len(seen.rows) == len(seen.groups) > 12000
    assert np.all(np.diff(seen.groups) >= 0)
    assert len(np.unique(seen.groups)) >= 20
    assert {"timestamp", "actual_q_0", "actual_qd_5", "joint_temperatures_3"} <= set(
        seen.quantities
    )
    assert all(len(v) == len(seen.rows) for v in seen.quantities.values())
    few = thinned(seen, 300)
    assert len(few.rows) == len(few.predict(())) == 300
    assert np.array_equal(few.predict(()), seen.predict(())[np.isin(seen.rows, few.rows)])


def test_a_pause_is_no_part_of_a_stretch_of_time(plant, recorded):
    torque = recorded[4]
    whole = observe(plant.model(2.0), log_of(recorded, torque), METROLOGY)
    t = recorded[0] + 600.0 * (np.arange(5000) >= 2500)
    paused = observe(plant.model(2.0), log_of((t, *recorded[1:]), torque), METROLOGY)
    counts = []
    for observation in (whole, paused):
        assert isinstance(observation, Observation)
        stretch = regions(observation, np.ones(len(observation.groups), dtype=bool))
        counts.append(np.bincount(stretch))
    assert len(counts[0]) == len(counts[1]) == STRETCHES
    assert np.abs(counts[1] - counts[0]).max() < 0.3 * counts[0].mean()


def test_readings_that_are_missing_are_left_out(plant, recorded):
    torque = recorded[4].copy()
    torque[100:200, 2] = np.nan
    log = log_of(recorded, torque)
    seen = observe(plant.model(2.0), log, METROLOGY)
    assert np.isfinite(seen.measured).all()
    assert not np.isin(np.arange(100, 200), seen.rows).any()


def test_what_is_missing_is_named(plant):
    q = np.zeros((3, N))
    none = observe(plant.model(), truth.log_of(N, actual_q=q), METROLOGY)
    assert none == NotObservable("torque", ("actual_current_as_torque",))
    blind = observe(plant.model(), truth.log_of(N, actual_current_as_torque=q), METROLOGY)
    assert blind == NotObservable("torque", ("actual_q",))


def test_columns_that_never_change_are_no_torques(recorded, plant):
    """A recorder writes zeros where a controller gives nothing: no cause is to be found there."""
    dead = observe(plant.model(2.0), silent(recorded), METROLOGY)
    assert dead == NotObservable("torque", ("actual_current_as_torque that changes",))


@pytest.mark.parametrize(("joint", "stands"), [(1, 0.0), (1, -37.25), (5, 0.0)])
def test_a_torque_that_never_changes_under_weights_that_do_is_no_torque(
    plant, recorded, joint, stands
):
    """One dead joint of six was a first moment of 10 kg m, or no payload, with certainty."""
    torque = recorded[4].copy()
    log = log_of(recorded, torque)
    log.columns["actual_current_as_torque"][:, joint] = stands
    assert observe(plant.model(2.0), log, METROLOGY) == NotObservable(
        "torque", (f"actual_current_as_torque_{joint} that changes",)
    )


def test_a_constant_torque_that_should_be_constant_is_one(plant):
    """Joint 1 of an upright arm bears no weight: a simulator without noise gives zeros there."""
    q = truth.poses(N, 60, 3)
    torque = plant.dynamics(q, 0 * q, 0 * q, payload=2.0)[0]
    torque[:, 0] = 0.0
    log = truth.log_of(
        N, timestamp=np.arange(60) * 5.0, actual_q=q, actual_current_as_torque=torque
    )
    assert isinstance(observe(plant.model(2.0), log, METROLOGY), Observation)


def test_sessions_of_one_pose_each_are_no_dead_torques(plant):
    """Six poses, each held for a while: within a session nothing changes, and nothing should."""
    q = np.repeat(truth.poses(N, 6, 3), 5, axis=0)
    torque = np.round(plant.dynamics(q, 0 * q, 0 * q, payload=2.0)[0], 1)
    log = truth.log_of(
        N, timestamp=np.arange(30.0) * 5, session=np.repeat(np.arange(6), 5), actual_q=q,
        actual_current_as_torque=torque,
    )  # fmt: skip
    seen = observe(plant.model(2.0), with_sessions(log, plant.model(2.0)), METROLOGY)
    assert isinstance(seen, Observation)
    assert len(seen.rows) == 30


def faded(plant, recorded):
    """Friction of joint 3 that was identified warm: more at first, less in the end."""
    t, _, qd, _, nominal = recorded
    here = np.arange(N) == 2
    fading = 0.25 - 0.5 * t / t[-1]
    return nominal + 6.0 * np.sign(qd) * here * fading[:, None]


def test_friction_that_fades_is_reported_as_unexplained_and_depends_on_time(plant, recorded):
    found = diagnose(plant.model(2.0), log_of(recorded, faded(plant, recorded)))
    (torque,) = (c for c in found.channels if c.channel == "torque")
    assert torque.structured
    assert "timestamp" in [name for name, _ in torque.depends_on[:3]]


@pytest.mark.parametrize(
    "effect",
    [
        *further("link_inertia"),
        pytest.param(
            "torque_constant",
            marks=pytest.mark.xfail(
                reason="no unnamed function scales a joint's own torque, so that a shifted centre "
                "of gravity and a rotor's inertia of that joint together pass for it",
                strict=True,
            ),
        ),
    ],
)
def test_what_bears_weight_is_not_blamed_for_one_another(plant, recorded, effect):
    joint, value = CASES[effect]
    log = log_of(recorded, torque_with(plant, recorded, effect, joint, value))
    found = diagnose(plant.model(2.0), log, withhold=(effect,))
    (torque,) = (c for c in found.channels if c.channel == "torque")
    assert torque.structured
    assert not torque.causes


@pytest.mark.slow
def test_first_moments_of_all_links_are_found_as_a_whole(plant, recorded, monkeypatch):
    """Centres of gravity centimetres off everywhere: none is sure, together they predict."""
    _, q, qd, qdd, _ = recorded
    nominal = type(plant).pinocchio

    def shifted(self, *arguments, **more):
        model = nominal(self, *arguments, **more)
        rng = np.random.default_rng(3)
        for i in range(1, N + 1):
            old = model.inertias[i]
            lever = old.lever + rng.normal(0, 0.02, 3)
            model.inertias[i] = pin.Inertia(old.mass, lever, old.inertia)
        return model

    monkeypatch.setattr(type(plant), "pinocchio", shifted)
    torque = plant.dynamics(q, qd, qdd, payload=2.0)[0]
    found = diagnose(plant.model(2.0), log_of(recorded, torque), METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "torque"]
    assert [(c.effect, c.joints) for c in channel.causes] == [("link_cog", (1, 2, 3, 4, 5, 6))]
    assert channel.remaining_rms_held_out < 1.01 * NOISE
    assert channel.gap_rms > 1.5 * NOISE
    moments = [np.array(t.values) for c in channel.causes for t in c.terms]
    assert max(np.abs(m).max() for m in moments) < 0.5  # kg m


@pytest.mark.slow
def test_friction_of_all_joints_belongs_to_the_links_and_accused_ones_are_significant(
    plant, recorded, monkeypatch
):
    """A real arm: every joint rubs, every centre of gravity is off; one zero is, and is named."""
    _, q, qd, qdd, _ = recorded
    nominal = type(plant).pinocchio

    def shifted(self, *arguments, **more):
        model = nominal(self, *arguments, **more)
        rng = np.random.default_rng(5)
        for i in range(1, N + 1):
            old = model.inertias[i]
            lever = old.lever + rng.normal(0, 0.01, 3)
            model.inertias[i] = pin.Inertia(old.mass, lever, old.inertia)
        return model

    monkeypatch.setattr(type(plant), "pinocchio", shifted)
    torque = plant.dynamics(q, qd, qdd, payload=2.0)[0] + 0.1 * FRICTION * np.sign(qd) + 0.2 * qd
    torque[:, 3] += 0.3
    found = diagnose(plant.model(2.0), log_of(recorded, torque), METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "torque"]
    causes = {c.effect: c for c in channel.causes}
    assert set(causes) == {"link_cog", "coulomb_friction", "viscous_friction", "torque_offset"}
    assert causes["coulomb_friction"].joints == causes["viscous_friction"].joints
    assert causes["torque_offset"].joints == (4,)
    sure = {p.name.split("_")[2] for p in causes["link_cog"].parameters
            if abs(p.value) > 3 * p.std}  # fmt: skip
    assert sure == {str(j) for j in causes["link_cog"].joints}
    rub = {t.site.joint: t.values[0] for t in causes["coulomb_friction"].terms}
    assert [rub[j + 1] for j in range(N)] == pytest.approx(0.1 * FRICTION, abs=0.06)
    assert channel.remaining_rms_held_out < 1.02 * NOISE


@pytest.mark.slow
def test_a_wrists_cause_counts_against_the_wrists_noise(plant, recorded, monkeypatch):
    """A centre of gravity 2 mm off: far above the wrist's noise, far below the shoulder's."""
    t, q, qd, qdd, _ = recorded
    model = plant.model(2.0)
    monkeypatch.setattr(truth, "COG", truth.COG + np.array([2e-3, -1e-3, 1e-3]))
    noise = np.array([10.0, 10.0, 5.0, 0.03, 0.03, 0.01])
    rng = np.random.default_rng(4)
    torque = plant.dynamics(q, qd, qdd, payload=2.0)[0] + rng.normal(0, noise, q.shape)
    log = truth.log_of(
        N, timestamp=t, actual_q=q, actual_qd=qd, actual_current_as_torque=torque
    )  # fmt: skip
    (channel,) = [c for c in diagnose(model, log, METROLOGY).channels if c.channel == "torque"]
    (cause,) = channel.causes
    assert cause.effect == "payload_cog"
    assert cause.shrink.interval[0] > 0.1
    assert cause.shrink.gap_with == pytest.approx(channel.remaining_rms_held_out, rel=0.05)
    assert channel.gap_rms == pytest.approx(channel.remaining_rms, rel=1e-3)  # over all joints


def test_a_light_links_shift_is_not_the_loads(plant, recorded, monkeypatch):
    """Both are the same first moment; the moments of inertia go with the square of the shift."""
    _, q, qd, qdd, _ = recorded
    nominal = type(plant).pinocchio

    def shifted(self, *arguments, **more):
        model = nominal(self, *arguments, **more)
        old = model.inertias[N]
        lever = old.lever + np.array([0.1, -0.05, 0.05])
        model.inertias[N] = pin.Inertia(old.mass, lever, old.inertia)
        return model

    monkeypatch.setattr(type(plant), "pinocchio", shifted)
    torque = plant.dynamics(q, qd, qdd, payload=10.0)[0]
    log = log_of(recorded, torque + np.random.default_rng(1).normal(0, 0.01, q.shape))
    found = diagnose(plant.model(10.0), log, METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "torque"]
    assert [(c.effect, c.joints) for c in channel.causes] == [("link_cog", (N,))]


def test_a_counterweight_is_found_with_its_whole_first_moment(plant, recorded, monkeypatch):
    """Many times what a link's own mass could be off: a refit has to converge from afar."""
    _, q, qd, qdd, torque = recorded
    nominal = type(plant).pinocchio
    step = np.array([-0.12, 0.04, 0.03])  # m of link 2

    def torque_at(shift):
        def moved(self, *arguments, **more):
            model = nominal(self, *arguments, **more)
            old = model.inertias[2]
            model.inertias[2] = pin.Inertia(old.mass, old.lever + shift, old.inertia)
            return model

        monkeypatch.setattr(type(plant), "pinocchio", moved)
        return plant.dynamics(q, qd, qdd, payload=2.0)[0]

    ahead, behind = torque_at(step), torque_at(-step)
    inertia = ((ahead + behind) / 2 - torque) * (dynamics.OWN_SHIFT / np.linalg.norm(step)) ** 2
    log = log_of(recorded, torque + 12 * (ahead - behind) / 2 + inertia)
    found = diagnose(plant.model(2.0), log, METROLOGY)
    (channel,) = [c for c in found.channels if c.channel == "torque"]
    (cause,) = [c for c in channel.causes if c.effect == "link_cog" and 2 in c.joints]
    of_link = {p.name[-1]: p for p in cause.parameters if p.name.startswith("link_cog_2")}
    for axis, moment in zip("xyz", plant.arm.mass[1] * 12 * step, strict=True):
        assert abs(of_link[axis].value - moment) < 3.5 * of_link[axis].std
    assert channel.remaining_rms_held_out < 1.02 * NOISE
