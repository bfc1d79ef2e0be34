"""Measured data of real arms: fitted on some poses, checked on others, or declined."""

import numpy as np
import pytest

from benchmarks.evidence import DATA, measured
from gapbridge.bridge.cell import load_cell
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import read_log

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measured data sets (../shared/data) are not beside this checkout"
)


def opened(name):
    cell = load_cell(DATA / name / "cell.yaml")
    return cell, read_log(DATA / name / "log.csv", cell.arm.n)


def rms(far):
    return float(np.sqrt(np.mean(far**2)))


def test_poses_that_are_checked_are_not_fitted():
    _, log = opened("tsinghua_ur5_grid")
    fit, held_out = measured.split(log)
    assert len(fit) + len(held_out) == len(log)
    apart = np.abs(fit.get("actual_q")[:, None] - held_out.get("actual_q")[None]).max(axis=2)
    assert apart.min() > 1e-3


def test_the_compliance_of_a_real_arm_brings_unseen_poses_nearer():
    cell, log = opened("tsinghua_ur5_grid")
    fit, held_out = measured.split(log)
    before = measured.distances(cell.model, held_out, measured.registered(cell.model, fit))
    found = identify_compliance(cell.model, fit, cell.metrology)
    after = measured.distances(found.model, held_out, found.registration)
    assert rms(after) < 0.95 * rms(before)


def test_the_page_shows_the_reason_where_fit_declines(capsys):
    cell, log = opened("barrett_wam_grid")
    measured.compare(cell.model, *measured.split(log), cell.metrology)
    reported = capsys.readouterr().out
    assert reported.count("fit declines: nothing in the log excites the compliance") == 2
    assert (
        "the arm's links have no mass in the cell, and no payload or pull is in the log" in reported
    )


def test_published_figures_stand_beside():
    lines = list(measured.published(DATA / "tsinghua_ur5_grid"))
    assert any("2.5664 mm uncalibrated -> 0.1549 mm" in line for line in lines)
