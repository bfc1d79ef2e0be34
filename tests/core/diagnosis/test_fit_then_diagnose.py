"""`fit`, then `diagnose` on the same log: what the first found the second does not take back."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import small_arm as small
from further import further

from gapbridge.core.calibration.spread import Spread
from gapbridge.core.diagnosis.diagnosis import channels_of, diagnose
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.metrology import Metrology

SOFT = replace(
    small.NOMINAL, axial=np.array(small.KIND.axial), radial=np.array(small.KIND.radial)
)  # fmt: skip
SHIFT = np.array([3e-3, -2e-3, 4e-3])  # m, flange axes
ZEROS = np.array([0.0, 1e-3, -8e-4])  # rad
COMPLIANCE = {"axial_compliance", "radial_compliance"}


def off_zero(session):
    return np.tile(ZEROS, (len(session.q), 1))


def moved(tool: bool, zeros: bool):
    """Return the arm with a tool point, or two joints' zeros, elsewhere than the cell has them."""
    there = small.TOOL + (SHIFT if tool else 0.0)
    return replace(SOFT, tool_position=there, angle_errors=(off_zero,) if zeros else ())


def fitted(real, registered: bool, seed: int):
    session = small.session_of(seed)
    log = small.log_of(session, small.readings(real, session, seed, registered))
    metrology = Metrology(registered, small.SIGMA)
    return log, metrology, identify_compliance(small.model_of(), log, metrology)


def sigmas_off(found):
    """Return how far the flexibilities are from the true ones (2n,), in what the fit states."""
    apart = np.concatenate([found.axial - SOFT.axial, found.radial - SOFT.radial])
    return np.abs(apart) / np.concatenate([found.std_axial, found.std_radial])


@pytest.mark.parametrize("seed", [11, *further(12)])
@pytest.mark.parametrize(
    ("tool", "registered"), [(False, True), (False, False), (True, True), (True, False)]
)
def test_no_further_cause_is_named(tool: bool, registered: bool, seed: int):
    log, metrology, found = fitted(moved(tool, zeros=False), registered, seed)
    shift = found.cell_model.tool_in_flange[:3, 3] - small.TOOL
    np.testing.assert_allclose(shift, SHIFT if tool else 0.0, atol=2e-5)
    assert sigmas_off(found).max() < 3.5
    assert found.remaining_rms < 1.15 * small.FLOOR
    (channel,) = diagnose(found.cell_model, log, metrology).channels
    assert channel.verdict == "no_gap"
    assert not channel.causes


@pytest.mark.parametrize("seed", [11, *further(12)])
@pytest.mark.parametrize(
    ("tool", "registered"), [(False, True), (False, False), (True, True), (True, False)]
)
def test_zeros_that_are_off_become_no_flexibilities(tool: bool, registered: bool, seed: int):
    log, metrology, found = fitted(moved(tool, zeros=True), registered, seed)
    assert sigmas_off(found).max() < 3.5
    (channel,) = diagnose(found.cell_model, log, metrology).channels
    causes = {c.effect: c for c in channel.causes}
    assert "joint_offset" in causes
    assert not COMPLIANCE & set(causes)
    (zero,) = (p for p in causes["joint_offset"].parameters if p.name == "joint_offset_2")
    assert zero.value == pytest.approx(ZEROS[1], abs=3e-5)
    assert channel.remaining_rms < 1.15 * small.FLOOR


@pytest.mark.slow
def test_a_cause_has_the_uncertainty_of_the_flexibilities_it_depends_on():
    """By how far it moves with them; a flexibility that is accused itself makes nothing unsure."""
    session = small.session_of(11)
    real = moved(tool=False, zeros=True)
    log = small.log_of(session, small.readings(real, session, 11, True))
    cell = small.model_of().with_compliance(SOFT.axial, SOFT.radial)
    sigma = 2e-7  # rad/Nm
    softer = cell.with_compliance(SOFT.axial + np.array([0.0, sigma, 0.0]), SOFT.radial)
    spread = Spread(("axial_compliance_2",), np.array([[sigma**2]]))
    unsure = channels_of(partial(spread.sigma_columns, cell))
    metrology = Metrology(True, small.SIGMA)

    def zero_2(model, **more):
        (channel,) = diagnose(model, log, metrology, **more).channels
        assert {c.effect for c in channel.causes} == {"joint_offset"}
        return next(p for p in channel.causes[0].parameters if p.name == "joint_offset_2")

    known, moves, found = zero_2(cell), zero_2(softer), zero_2(cell, observers=unsure)
    assert found.value == pytest.approx(known.value, rel=1e-6)
    wider = np.sqrt(found.std**2 - known.std**2)
    assert wider == pytest.approx(abs(moves.value - known.value), rel=0.1)
    q, loads = log.columns["actual_q"], log.loads()
    (term,) = (t for t in cell.terms if (t.effect, t.site.joint) == ("axial_compliance", 2))
    assert spread.sigma_columns(cell, q, loads, ()).shape == (len(q), 6, 1)
    assert spread.sigma_columns(cell, q, loads, (term,)).shape == (len(q), 6, 0)


def test_an_arm_with_nominal_links_is_fitted_as_if_they_were_known(monkeypatch):
    """The links are let in where the poses are likelier with them, and cost nothing elsewhere."""
    _, _, found = fitted(SOFT, True, 11)
    monkeypatch.setattr("gapbridge.core.estimation.geometry.MIN_LIKELIHOOD_GAIN", np.inf)
    _, _, alone = fitted(SOFT, True, 11)
    np.testing.assert_array_equal(found.covariance, alone.covariance)


def test_a_tool_point_that_is_not_identifiable_is_the_cells():
    """Turned by joint 1 alone: a shift of the tool along its axis is one of the frame."""
    session = small.session_of(3)
    q = session.q.copy()
    q[:, 1:] = q[0, 1:]
    session = replace(session, q=q)
    log = small.log_of(session, small.readings(SOFT, session, 3, registered=False))
    found = identify_compliance(small.model_of(), log, Metrology(False, small.SIGMA))
    assert not found.tool_determined
    np.testing.assert_allclose(found.cell_model.tool_in_flange[:3, 3], small.TOOL, atol=1e-12)
