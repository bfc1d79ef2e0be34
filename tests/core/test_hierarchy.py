"""The fleet's fit: what a session determines, what is borrowed, and whether intervals hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import Generator
from numpy.typing import NDArray

from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import ExcitationError
from gapbridge.core.estimation.hierarchical import TypeFit, fit_type
from gapbridge.core.estimation.hierarchical_evidence import Evidence, evidence
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix, rotation_vector

Array = NDArray[np.float64]
AXIAL = np.array([3e-6, 8e-6, 7e-6, 1e-5, 1.2e-5, 2e-5])  # rad/Nm
RADIAL = np.array([1e-6, 1e-6, 2e-6, 2e-6, 3e-6, 3e-6])
TRUTH = np.concatenate([AXIAL, RADIAL])
NOMINAL = Model(builtin_arm("ur10e"))
USUAL = 5e-6
MEAN = np.array([8e-6, 5e-6, 1e-5, 4e-6])  # of a type with two joints
NOISE = 3e-5  # m


def session(rows: int, seed: int, noise: float = 0.0, *, rotation: bool = False) -> Log:
    """Return a log of the bent arm, measured in a frame that nobody knows."""
    rng = np.random.default_rng(seed)
    q = np.array([0.0, -1.2, 1.5, -1.8, -1.5, 0.0]) + rng.uniform(-0.9, 0.9, (rows, 6))
    pull = np.hstack([rng.uniform(-60, 60, (rows, 3)), rng.uniform(-8, 8, (rows, 3))])
    mass, cog = rng.choice([0.0, 5.0, 10.0], rows), np.tile([0.0, 0.02, 0.1], (rows, 1))
    poses = NOMINAL.with_compliance(AXIAL, RADIAL).predict(q, Loads(mass, cog, pull))
    turn = rotation_matrix(np.array([[0.3, -0.2, 0.9]]))[0]
    position = poses.position @ turn.T + [1.0, 2.0, 0.5] + rng.normal(0, 1, (rows, 3)) * noise
    columns = {
        "actual_q": q, "payload": mass, "payload_cog": cog, "actual_TCP_force": pull,
        "measured_position": position,
    }  # fmt: skip
    if rotation:
        columns["measured_rotation"] = rotation_vector(turn @ poses.rotation)
    return Log("log.csv", columns, 6)


@pytest.mark.parametrize("rotation", [False, True])
def test_the_truth_solves_the_equations_of_a_session_without_noise(rotation: bool) -> None:
    found = evidence(NOMINAL, session(30, 0, rotation=rotation))
    scale = np.abs(found.right).max()
    assert np.abs(found.matrix @ TRUTH - found.right).max() < 1e-5 * scale
    assert found.squares < 1e-10 * scale**2
    assert found.poses == 30


def test_what_is_left_over_shows_the_noise() -> None:
    given = [evidence(NOMINAL, session(20, seed, NOISE)) for seed in range(6)]
    variance = sum(e.squares for e in given) / sum(e.freedom for e in given)
    assert np.sqrt(variance) == pytest.approx(NOISE, rel=0.12)


def test_a_outlier_reading_is_set_aside() -> None:
    log = session(25, 1, 1e-5)
    log.columns["measured_position"][7] += 0.05
    found = evidence(NOMINAL, log)
    assert (found.outliers, found.poses) == (1, 24)
    assert np.abs(found.matrix @ TRUTH - found.right).max() < 1e-3


def test_a_session_of_too_few_poses_reports_nothing() -> None:
    with pytest.raises(ExcitationError, match=r"found 3 row\(s\).* expected at least 4"):
        evidence(NOMINAL, session(3, 0))
    registered = Metrology(registered=True)
    with pytest.raises(ExcitationError, match=r"found 1 row\(s\).* expected at least 2"):
        evidence(NOMINAL, session(1, 0), registered)
    assert evidence(NOMINAL, session(2, 0), registered).poses == 2


@pytest.mark.parametrize("rotation", [False, True])
def test_a_bent_tool_leaves_the_equations_of_a_registered_cell_as_they_are(rotation: bool) -> None:
    log = session(30, 0, rotation=rotation)
    turn = rotation_matrix(np.array([[0.3, -0.2, 0.9]]))[0]  # back into base
    log.columns["measured_position"] = (log.columns["measured_position"] - [1.0, 2.0, 0.5]) @ turn
    if rotation:
        axes = rotation_matrix(log.columns["measured_rotation"])
        log.columns["measured_rotation"] = rotation_vector(turn.T @ axes)
    bent = NOMINAL.tool_in_flange.copy()
    bent[:3, 3] += [0.001, -0.0005, 0.002]
    found = evidence(replace(NOMINAL, tool_in_flange=bent), log, Metrology(registered=True))
    scale = np.abs(found.right).max()
    assert np.abs(found.matrix @ TRUTH - found.right).max() < 1e-5 * scale
    assert found.squares < 1e-10 * scale**2


def reported(truth: Array, rng: Generator, rows: int = 6, gain: float = 1.0) -> Evidence:
    """Return what a session of an arm determines, straight from the linear model."""
    A = rng.normal(0, 1, (rows, 4)) * [40, 8, 25, 4] * gain * np.sqrt(8 / rows)  # m per rad/Nm
    y = A @ truth + rng.normal(0, NOISE, rows)
    R = np.linalg.qr(A, mode="r")
    right = np.linalg.lstsq(R.T, A.T @ y, rcond=None)[0]
    left = max(float(y @ y - right @ right), 0.0)
    rest = NOISE**2 * rng.chisquare(8)
    return Evidence(R, right, left + rest, 8.0 + rows - 4, 1e-6, rows, 0)


def scattered(values: Array, share: float, rng: Generator) -> Array:
    return np.asarray(values * (1 + share * rng.normal(size=values.shape)))


def fleet(arms: int, sessions: int, seed: int) -> tuple[TypeFit, Array, list[Evidence]]:
    """Return the fit of a fleet made up, its truths (A, 4) and its sessions."""
    rng = np.random.default_rng(seed)
    truths = np.array([scattered(MEAN, 0.25, rng) for _ in range(arms)])
    number = np.repeat(np.arange(arms), sessions)
    # the only session of an arm is the arm: nobody can separate them
    within = 0.03 if sessions > 1 else 0.0
    given = [reported(scattered(truths[a], within, rng), rng) for a in number]
    return fit_type(given, list(number), np.zeros(4), USUAL), truths, given


def test_arms_with_few_poses_gain_by_borrowing_and_their_intervals_hold() -> None:
    better, inside = [], []
    for seed in range(3):
        fit, truths, given = fleet(30, 1, seed)
        together = np.array([arm.flexibility for arm in fit.arms])
        alone = np.array([np.linalg.lstsq(e.matrix, e.right, rcond=None)[0] for e in given])
        better.append(np.sum((together - truths) ** 2) / np.sum((alone - truths) ** 2))
        std = np.array([arm.std for arm in fit.arms])
        inside.append(np.abs(together - truths) < 1.96 * std)
    assert np.median(better) < 0.5
    assert 0.91 < np.mean(inside) < 0.985


def test_a_flexibility_of_a_type_is_not_negative() -> None:
    stiff = MEAN * [1, 0, 1, 1]
    for seed in range(4):
        rng = np.random.default_rng(seed)
        fit = fit_type([reported(stiff, rng) for _ in range(4)], [0, 1, 2, 3], np.zeros(4), USUAL)
        assert (fit.scatter.mean >= 0).all()


def test_scatter_between_arms_and_noise_are_found() -> None:
    fit, truths, _ = fleet(90, 3, 5)
    scatter = fit.scatter
    assert scatter.noise == pytest.approx(NOISE, rel=0.1)
    assert scatter.between_arms / MEAN == pytest.approx(np.full(4, 0.25), rel=0.35)
    assert (scatter.between_sessions / MEAN < 0.08).all()
    std = np.sqrt(np.diag(scatter.covariance))
    assert (np.abs(scatter.mean - truths.mean(axis=0)) < 4 * std).all()


def test_an_arm_keeps_what_its_data_say_and_takes_the_type_where_they_say_nothing() -> None:
    rng = np.random.default_rng(7)
    truths = [scattered(MEAN, 0.25, rng) for _ in range(20)]
    given = [reported(t, rng, gain=100 if i == 0 else 1) for i, t in enumerate(truths)]
    given[1] = replace(given[1], matrix=np.zeros((4, 4)), right=np.zeros(4))
    fit = fit_type(given, list(range(20)), np.zeros(4), USUAL)
    assert fit.arms[0].flexibility == pytest.approx(truths[0], rel=0.02)
    assert (fit.arms[0].own_share > 0.95).all()
    assert fit.arms[1].flexibility == pytest.approx(fit.scatter.mean, rel=0.05)
    assert (fit.arms[1].own_share < 1e-6).all()
    assert (fit.arms[1].std > fit.arms[0].std).all()


def test_what_no_session_shows_stays_at_the_nominal_and_is_reported() -> None:
    _, _, given = fleet(10, 1, 3)
    blind = []
    for one in given:
        matrix = one.matrix.copy()
        matrix[:, 1] = 0.0
        blind.append(replace(one, matrix=matrix))
    fit = fit_type(blind, list(range(10)), MEAN, USUAL)
    assert fit.scatter.identifiable.tolist() == [True, False, True, True]
    assert fit.scatter.mean[1] == pytest.approx(MEAN[1], rel=1e-6)


def test_the_drifting_arm_alone_is_found_to_drift() -> None:
    rng = np.random.default_rng(11)
    given, number = [], []
    for arm in range(20):
        truth = scattered(MEAN, 0.25, rng)
        for step in range(4):
            now = scattered(truth, 0.02, rng)
            now[0] += 1.5e-6 * step * (arm == 4)
            given.append(reported(now, rng, 8))
            number.append(arm)
    fit = fit_type(given, number, np.zeros(4), USUAL)
    z = np.array([arm.drift / arm.drift_std for arm in fit.arms])
    assert np.argmax(np.abs(z[:, 0])) == 4
    assert fit.arms[4].drift[0] == pytest.approx(1.5e-6, abs=3 * fit.arms[4].drift_std[0])
    others = np.delete(z, 4, axis=0)
    assert np.sqrt(np.mean(others**2)) == pytest.approx(1.0, abs=0.3)


def test_two_sessions_show_no_drift_and_a_session_is_foretold_without_itself() -> None:
    _, _, given = fleet(12, 2, 13)
    number = list(np.repeat(np.arange(12), 2))
    fit = fit_type(given, number, np.zeros(4), USUAL)
    assert all(np.isnan(arm.drift).all() for arm in fit.arms)
    changed = [*given]
    changed[0] = replace(given[0], right=given[0].right + 1e-4)
    again = fit_type(changed, number, np.zeros(4), USUAL)
    moved = [np.abs(again.sessions[0].without - fit.sessions[0].without),
             np.abs(again.arms[0].flexibility - fit.arms[0].flexibility)]  # fmt: skip
    assert moved[0].max() < 0.5 * moved[1].max()


def test_the_order_of_arms_does_not_matter_to_large_fleets() -> None:
    rng = np.random.default_rng(2)
    truths = [scattered(MEAN, 0.25, rng) for _ in range(120)]
    given = [reported(t, rng, 8) for t in truths]
    order = rng.permutation(120)
    fit = fit_type(given, list(range(120)), np.zeros(4), USUAL)
    other = fit_type([given[i] for i in order], list(range(120)), np.zeros(4), USUAL)
    for place, i in enumerate(order):
        assert other.arms[place].flexibility == pytest.approx(fit.arms[i].flexibility, rel=1e-6)
