"""A session whose readings show a missing effect: offered, confirmed, fitted, written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scripted_session import (
    FRAME,
    CommandResult,
    plan_in,
    reading_line,
    run_calibrate,
    session_lines,
    truth,
    write_cell,
)

from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.registration import register
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

ERROR = Term("transmission_error", Site(2, 2.0), (1.8e-4, -1.2e-4))


def true_arm() -> Model:
    """Return the true arm, joint 2 with an effect that the cell does not fit."""
    return truth().with_terms([ERROR])


def tracker_lines(plan: Plan) -> list[str]:
    """Return the typed readings of a tracker at each stop."""
    found = tcp_positions(plan) + np.random.default_rng(4).normal(0, 2e-5, (len(plan.poses), 3))
    return [reading_line(v) for v in found @ FRAME.rotation.T + FRAME.position]


def tcp_positions(plan: Plan, model: Model | None = None) -> np.ndarray:
    """Return the TCP of a model at each stop (N, 3), m, in base."""
    loads = Loads(
        payload_mass=np.array([plan.loads[p.load].mass for p in plan.poses]),
        payload_cog=np.array([plan.loads[p.load].cog for p in plan.poses]),
    )
    q = np.array([p.q for p in plan.poses])
    return (model or true_arm()).predict(q, loads).position


@pytest.fixture(scope="module")
def refitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, CommandResult]:
    folder = tmp_path_factory.mktemp("refit")
    cell = write_cell(folder, poses=18)
    assert run_calibrate(cell, "--plan-only", "--session", folder / "s").code == 0
    plan = plan_in(folder / "s")
    lines = [*session_lines(plan, tracker_lines(plan)), "yes", "yes"]
    return folder, run_calibrate(
        cell, "--session", folder / "s", "--apply", folder / "new.yaml", lines=lines
    )


@pytest.mark.slow
def test_a_missing_effect_is_offered_and_fitted_after_confirmation(
    refitted: tuple[Path, CommandResult],
) -> None:
    folder, result = refitted
    assert result.code == 0, result.err
    assert "poses indicate transmission_error_2 as well. Fit again with it?" in result.out
    offered, judged = result.out.index("Fit again"), result.out.index("poses to verify:")
    assert offered < judged  # held-out poses are used once, by the final fit
    assert result.out.count("poses to verify:") == 1
    found = [t for t in load_cell(folder / "new.yaml").model.terms if t.effect == ERROR.effect]
    second = next(t for t in found if t.site == ERROR.site)
    assert second.values == pytest.approx(ERROR.values, abs=1.2e-4)


@pytest.mark.slow
def test_the_refitted_cell_predicts_the_arm(refitted: tuple[Path, CommandResult]) -> None:
    folder, _ = refitted
    plan = plan_in(folder / "s")
    predicted = tcp_positions(plan, load_cell(folder / "new.yaml").model)
    deviation = np.linalg.norm(
        register(tcp_positions(plan), predicted).in_base(tcp_positions(plan)) - predicted, axis=1
    )
    assert deviation.max() < 1e-4


@pytest.mark.slow
def test_the_refitted_cell_has_provenance_and_uncertainty(
    refitted: tuple[Path, CommandResult],
) -> None:
    folder, _ = refitted
    cell = load_cell(folder / "new.yaml")
    origin = cell.file.provenance
    assert origin is not None
    assert origin.command == "calibrate"
    assert {file.role for file in origin.files} == {"log", "cell"}
    assert "transmission_error_2_order2_cos" in " ".join(cell.spread.names)
    assert set(cell.intervals) <= set(cell.spread.names)
    assert all(low < high for low, high in cell.intervals.values())
    assert {f"transmission_error_2_order2_{part}" for part in ("sine", "cosine")} < set(
        cell.intervals
    )
    q = np.array([p.q for p in plan_in(folder / "s").poses])
    std = cell.spread.poses_and_std(cell.model, q, None)[1]
    assert 0 < std.max() < 2e-4
