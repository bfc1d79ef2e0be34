"""Slips, droop and dead bands in a diagnosis: found, dated, separated, and named where unseen."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from further import further

from gapbridge.bridge.document.findings import finding_text
from gapbridge.core.arm import builtin_arm
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.finding import Check
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import judge
from gapbridge.core.diagnosis.selection.sample_space import fit
from gapbridge.core.effects import Site, Term
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

MODEL = Model(builtin_arm("ur10e"), payload_mass=4.0, payload_cog=np.array([0.0, 0.02, 0.1]))
SIGMA = 3e-5  # m


def sampled(
    terms: list[Term], count: int = 70, seed: int = 0, clock: bool = True,
    at: float | tuple[float, ...] = 0.6,
) -> Log:  # fmt: skip
    """Return poses at rest, measured in a frame that nobody registered, with ``terms`` in the arm.

    The truth of a slip is put in by hand: rows before and after ``at`` (a share) are two arms. Of
    several slips ``at`` may give that of each, in order of time.
    """
    rng = np.random.default_rng(seed)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-0.8, 0.8, (count, 6))
    loads = Loads(payload_mass=rng.choice([1.0, 4.0, 8.0], count))
    still = [t for t in terms if not t.effect.endswith("_slip")]
    position = MODEL.with_terms(still).predict(q, loads).position
    slips = [t for t in terms if t not in still]
    slipped = []
    for term, share in zip(slips, at if isinstance(at, tuple) else (at,) * len(slips), strict=True):
        moment = int(share * count)
        stands = "joint_offset" if term.effect == "joint_slip" else "tool_frame"
        values = term.values if term.site.joint else (*term.values, 0.0, 0.0, 0.0)
        slipped.append(Term(stands, term.site, values))
        after = MODEL.with_terms([*still, *slipped])
        position[moment:] = after.predict(q, loads).position[moment:]
    position = position + SIGMA * rng.standard_normal(position.shape) + [0.3, -0.2, 0.1]
    columns = {"actual_q": q, "payload": loads.payload_mass, "measured_position": position}
    if clock:
        columns["timestamp"] = 1.7e9 + 40.0 * np.arange(count)
    return Log("slip.csv", columns, 6)


def position(log: Log) -> tuple[ChannelDiagnosis, tuple[str, ...]]:
    found = diagnose(MODEL, log, Metrology(registered=False, sigma=2e-5))
    (channel,) = [c for c in found.channels if c.channel == "position"]
    return channel, tuple(finding_text(f) for f in found.findings)


@pytest.mark.parametrize("clock", [True, False])
def test_a_joint_that_slips_is_named_sized_and_dated(clock: bool) -> None:
    channel, findings = position(sampled([Term("joint_slip", Site(3), (2e-3,))], clock=clock))
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("joint_slip", (3,))
    size, moment = cause.parameters
    assert (size.name, moment.name) == ("joint_slip_3", "joint_slip_3_time")
    assert size.std is not None
    assert abs(size.value - 2e-3) < 3 * size.std
    true = 1.7e9 + 40.0 * 41.5 if clock else 42.5
    assert abs(moment.value - true) <= (20.0 if clock else 0.5)
    (sentence,) = [f for f in findings if "joint_slip" in f]
    assert f"the zero of joint 3 moved by {1e3 * size.value:.3g} mrad (0.115 deg)" in sentence
    assert "before and after it nothing else changed" in sentence
    assert ("22:40:40" in sentence) is clock
    rows = "between rows 42 and 43 of the log, counted without its header"
    assert (rows in sentence) is not clock


@pytest.mark.parametrize("joint", [1, *further(4, 5)])
@pytest.mark.parametrize("at", [0.12, 0.88])
def test_rows_beyond_a_slip_near_an_end_are_no_bad_readings(joint: int, at: float) -> None:
    """Few rows have it, so that they stand out of a fit of all the others; one is bad by chance."""
    log = sampled([Term("joint_slip", Site(joint), (5e-3,))], at=at)
    log.columns["measured_position"][33] += [4e-3, -3e-3, 5e-3]
    channel, _ = position(log)
    (cause,) = channel.causes
    assert (cause.effect, cause.joints) == ("joint_slip", (joint,))
    size, moment = cause.parameters
    assert size.std is not None
    assert abs(size.value - 5e-3) < 4 * size.std
    assert abs(moment.value - 1.7e9 - 40.0 * (int(70 * at) - 0.5)) <= 20.0
    assert channel.outliers == (33,)


def test_a_target_that_slips_is_no_joint_that_does() -> None:
    shift = (1e-3, -5e-4, 2e-3)
    channel, findings = position(sampled([Term("target_slip", Site(), shift)]))
    (cause,) = channel.causes
    assert cause.effect == "target_slip"
    for reported, true in zip(cause.parameters, shift, strict=False):
        assert reported.std is not None
        assert abs(reported.value - true) < 4 * reported.std
    (sentence,) = [f for f in findings if "target_slip" in f]
    (far,) = re.findall(r"the target on the tool moved by (\S+) mm", sentence)
    assert abs(float(far) - 1e3 * np.linalg.norm(shift)) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_slips_among_larger_ones_are_found_at_their_times(seed: int) -> None:
    terms = [Term("joint_slip", Site(2), (3e-3,)), Term("joint_slip", Site(5), (6e-4,)),
             Term("joint_slip", Site(3), (-2e-3,))]  # fmt: skip
    channel, _ = position(sampled(terms, seed=seed, at=(0.3, 0.5, 0.8)))
    named = {(c.effect, c.joints): c.parameters for c in channel.causes}
    assert {joint for (_, joints) in named for joint in joints} == {2, 3, 5}
    assert {effect for effect, _ in named} == {"joint_slip"}


def test_a_slip_in_addition_to_a_constant_offset() -> None:
    terms = [Term("joint_slip", Site(4), (-3e-3,)), Term("joint_offset", Site(2), (1e-3,))]
    channel, _ = position(sampled(terms, seed=2))
    found = {(c.effect, c.joints) for c in channel.causes}
    assert found == {("joint_slip", (4,)), ("joint_offset", (2,))}


@pytest.mark.parametrize(("goes_by", "other"), [("payload", "payload"), ("actual_q_1", None)])
def test_a_target_that_moves_as_the_load_changes_depends_on_the_load(goes_by, other) -> None:
    """Only beside something unnamed that goes by the load, too: else a slip comes when it comes."""
    log = sampled([Term("target_slip", Site(), (1e-3, -5e-4, 2e-3))], at=0.5)
    late = np.arange(70) >= 35
    log.columns["payload"] = np.where(late, 8.0, np.where(np.arange(70) >= 20, 1.0, 4.0))
    found, _ = position(log)
    selection, time = found.selection, log.columns["timestamp"]
    candidates = selection.space.candidates
    slip = next(
        c for c, k in enumerate(candidates)
        if k.family == "target_slip" and time[34] < k.fixed[-1] < time[35]
    )  # fmt: skip
    unnamed = next(c for c, k in enumerate(candidates) if k.quantity == goes_by)
    both = replace(
        selection, best=fit(selection.space, (slip, unnamed)), term_index=(slip,),
        terms=(candidates[slip].term(np.array([1e-3, -5e-4, 2e-3])),),
        covariance=(1e-12 * np.eye(3),),
    )  # fmt: skip
    withdrawn = [why for _, why in judge(both, HeldOut(both)).withdrawn]
    assert [w.quantity for w in withdrawn if w.failed is Check.NOT_A_LEVEL] == [other] * bool(other)


def test_nothing_slips_in_noise() -> None:
    for seed in range(3):
        channel, _ = position(sampled([], seed=10 + seed))
        assert channel.causes == ()
        assert channel.verdict == "no_gap"


def rests(
    terms: list[Term], q: np.ndarray, loads: Loads, bend: float = 0.0
) -> dict[str, np.ndarray]:
    """Return targets and encoders of servos at rest, by hand: no code of the model's.

    ``bend``: by how much more the droop is at 20 Nm than in proportion to the torque.
    """
    actual = q.copy()
    for _ in range(4):
        held = MODEL.holding_torque(actual, loads)
        actual = q.copy()
        for term in terms:
            j = term.site.joint - 1
            droops = held[:, j] * (1 + bend * np.abs(held[:, j]) / 20)
            by = droops if term.effect == "servo_droop" else loads.approach[:, j]
            actual[:, j] -= term.values[0] * by
    noise = 1e-5 * np.random.default_rng(5).standard_normal(q.shape)
    return {"target_q": q, "actual_q": actual + noise}


def followed(terms: list[Term], both: bool = True, move: bool = True) -> ChannelDiagnosis:
    rng = np.random.default_rng(3)
    centre = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0])
    q = centre + rng.uniform(-0.8, 0.8, (50, 6)) * (1.0 if move else np.array([1, 0, 0, 0, 0, 0]))
    side = rng.choice([-1.0, 1.0], q.shape) if both else np.ones(q.shape)
    loads = Loads(approach=side)
    columns = rests(terms, q, loads) | {"approach": side}
    (channel,) = diagnose(MODEL, Log("r", columns, 6)).channels
    return channel


def test_droop_and_dead_band_are_found_side_by_side() -> None:
    channel = followed([Term("servo_droop", Site(2), (4e-5,)), Term("dead_band", Site(4), (1e-3,))])
    values = {p.name: p.value for c in channel.causes for p in c.parameters}
    assert values.keys() == {"servo_droop_2", "dead_band_4"}
    assert values["servo_droop_2"] == pytest.approx(4e-5, rel=0.02)
    assert values["dead_band_4"] == pytest.approx(1e-3, rel=0.02)
    assert channel.verdict == "explained"


def test_a_droop_of_a_wrist_is_found() -> None:
    """It holds a newton metre where the shoulder holds a hundred: that makes no droop absurd."""
    channel = followed([Term("servo_droop", Site(5), (8e-3,))])
    ((value,),) = ([p.value for p in c.parameters] for c in channel.causes)
    assert channel.causes[0].joints == (5,)
    assert value == pytest.approx(8e-3, rel=0.02)


@pytest.mark.parametrize("bend", [0.01, 0.05])
def test_a_droop_that_is_not_quite_linear_is_named(bend: float) -> None:
    rng = np.random.default_rng(7)
    q = np.array([0.2, -1.2, 1.4, -1.0, -1.4, 0.3]) + rng.uniform(-0.8, 0.8, (60, 6))
    droop = {2: 2e-5, 3: 4e-5, 4: 5e-4}
    terms = [Term("servo_droop", Site(j), (c,)) for j, c in droop.items()]
    log = Log("r", rests(terms, q, Loads(), bend), 6)
    (channel,) = diagnose(MODEL, log).channels
    assert [(c.effect, c.joints) for c in channel.causes] == [("servo_droop", (2, 3, 4))]
    assert channel.remaining_rms < 0.2 * channel.gap_rms
    for p in channel.causes[0].parameters:  # the mean slope, over at most 180 Nm
        assert 0.9 < p.value / droop[int(p.name[-1])] < 1 + 10 * bend


def test_what_joints_hold_is_named_where_droop_is_out_of_the_catalogue() -> None:
    rng = np.random.default_rng(3)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-0.8, 0.8, (50, 6))
    loads = Loads(approach=np.ones(q.shape))
    columns = rests([Term("servo_droop", Site(2), (4e-5,))], q, loads)
    columns["timestamp"] = 40.0 * np.arange(50)
    found = diagnose(MODEL, Log("r", columns, 6), withhold=["servo_droop"])
    (channel,) = found.channels
    assert channel.verdict == "unexplained"
    assert channel.depends_on[0][0] == "held_torque_1"


def test_a_joint_that_holds_the_same_all_the_time_shows_no_droop_and_the_motion_is_named() -> None:
    channel = followed([], move=False)
    assert channel.causes == ()
    upright = Model(builtin_arm("ur10e"), gravity=np.array([0.0, 0.0, -1e-9]))
    q = np.random.default_rng(1).uniform(-1, 1, (40, 6))
    log = Log("r", {"target_q": q, "actual_q": q + 1e-5 * np.cos(7 * q)}, 6)
    (channel,) = diagnose(upright, log).channels
    (droop,) = [c for c in channel.considered if c.effect == "servo_droop"]
    assert not droop.excited
    assert "change the torque that the joint holds" in droop.needs


@pytest.mark.slow
def test_a_small_slip_of_the_target_is_accused_with_a_flexible_tool() -> None:
    """Of three numbers that are sure together none has to be as sure as one by itself."""
    log = sampled([Term("target_slip", Site(), (2e-4, -1.2e-4, 1e-4))], seed=1)
    loads = Loads(payload_mass=log.columns["payload"])
    rotation = MODEL.predict(log.columns["actual_q"], loads).rotation
    x, y = -rotation[:, 2, 0], -rotation[:, 2, 1]
    bent = 8e-4 * np.stack([x * np.abs(x), 1.5 * y * x**2, 0 * x], axis=1)
    log.columns["measured_position"] += np.einsum("nij,nj->ni", rotation, bent)
    channel, _ = position(log)
    assert [c.effect for c in channel.causes] == ["target_slip"]
    assert channel.structured
