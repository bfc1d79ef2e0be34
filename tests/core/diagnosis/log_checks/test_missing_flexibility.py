"""A rigid cell of a soft arm: the fit that should come first is named, with what it brings."""

from __future__ import annotations

import re

import numpy as np
import pytest

from benchmarks.fleet.simulating import TYPE, Habits, TrueArm, columns, write_type_cell
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.document.findings import finding_text
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.diagnosis.log_checks.missing_flexibility import flexibility_findings
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

FREE = Metrology(sigma=2.0e-5)
STIFF = TrueArm(np.zeros(6), np.zeros(6))


@pytest.fixture(scope="module")
def rigid(tmp_path_factory: pytest.TempPathFactory) -> Model:
    return load_cell(write_type_cell(tmp_path_factory.mktemp("cell"))).model


def log_of(arm: TrueArm, poses: int = 70, seed: int = 3) -> Log:
    return Log("log.csv", columns(arm, poses, Habits(), np.random.default_rng(seed)), 6)


@pytest.mark.slow
def test_a_soft_arm_behind_a_rigid_cell_is_sent_to_the_fit(rigid: Model) -> None:
    found = diagnose(rigid, log_of(TYPE), FREE)
    assert found.verdict in ("explained", "partly_explained")  # a dozen flexibilities, one by one
    assert {c.effect for c in found.channels[0].causes} & {"axial_compliance", "radial_compliance"}
    (advice,) = flexibility_findings(rigid, log_of(TYPE), FREE)
    assert (advice in found.findings) is (found.verdict == "partly_explained")
    reported = re.search(r"from ([\d.]+) mm to ([\d.]+) mm", finding_text(advice))
    assert reported is not None
    before, after = map(float, reported.groups())
    assert before == pytest.approx(1e3 * found.channels[0].gap_rms, rel=0.2)
    assert after < 0.05


def test_nothing_is_reported_where_the_cell_names_flexibilities(rigid: Model) -> None:
    half = rigid.with_compliance(TYPE.axial / 2, TYPE.radial / 2)
    assert flexibility_findings(half, log_of(TYPE), FREE) == []


def test_nothing_is_reported_where_softness_is_not_the_main_thing(rigid: Model) -> None:
    log = log_of(STIFF)
    log.columns["actual_q"][:, 1] += 2e-3 * np.sin(3 * log.columns["actual_q"][:, 0])
    assert flexibility_findings(rigid, log, FREE) == []


def test_nothing_is_reported_where_no_fit_can_be_made(rigid: Model) -> None:
    few = log_of(TYPE, poses=4)
    assert flexibility_findings(rigid, few, FREE) == []


@pytest.mark.slow
def test_what_is_withheld_is_not_offered(rigid: Model) -> None:
    found = diagnose(rigid, log_of(TYPE), FREE, withhold=("axial_compliance", "radial_compliance"))
    assert found.verdict != "no_gap"
    assert not any("gapbridge fit" in finding_text(f) for f in found.findings)


@pytest.mark.slow
def test_fit_and_diagnosis_exclude_the_same_outliers_and_do_not_undo_each_other(
    rigid: Model,
) -> None:
    log, rng = log_of(TYPE), np.random.default_rng(102)
    bad = np.sort(rng.choice(70, 5, replace=False))
    log.columns["measured_position"][bad] += rng.normal(size=(5, 3)) * 4e-3
    fitted = identify_compliance(rigid, log, FREE)
    assert sorted(fitted.outliers) == bad.tolist()
    (alone,) = diagnose(rigid, log, FREE).channels
    assert np.flatnonzero(~alone.selection.kept).tolist() == bad.tolist()
    assert alone.remaining_rms < 3e-5
    (after,) = diagnose(fitted.model, log, FREE).channels
    assert (after.verdict, after.causes) == ("no_gap", ())
    assert np.flatnonzero(~after.selection.kept).tolist() == bad.tolist()
