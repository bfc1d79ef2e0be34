"""A session that ends with the fit that its readings ask for: reported, asked, fitted, written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from played import FRAME, Played, plan_in, play, script, truth, typed, write_cell

from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.registration import register
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

WAVE = Term("transmission_error", Site(2, 2.0), (1.8e-4, -1.2e-4))


def waving() -> Model:
    """Return the hidden arm, joint 2 with an error that the cell's effects do not name."""
    return truth().with_terms([WAVE])


def reported(plan: Plan) -> list[str]:
    """Return what a tracker reads at each stop, as a person types it."""
    found = there(plan) + np.random.default_rng(4).normal(0, 2e-5, (len(plan.poses), 3))
    return [typed(v) for v in found @ FRAME.rotation.T + FRAME.position]


def there(plan: Plan, model: Model | None = None) -> np.ndarray:
    """Return where a model's TCP is at each stop (N, 3), base."""
    loads = Loads(
        payload_mass=np.array([plan.loads[p.load].mass for p in plan.poses]),
        payload_cog=np.array([plan.loads[p.load].cog for p in plan.poses]),
    )
    q = np.array([p.q for p in plan.poses])
    return (model or waving()).predict(q, loads).position


@pytest.fixture(scope="module")
def ended(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Played]:
    folder = tmp_path_factory.mktemp("refit")
    cell = write_cell(folder, poses=18)
    assert play(cell, "--plan-only", "--session", folder / "s").code == 0
    plan = plan_in(folder / "s")
    lines = [*script(plan, reported(plan)), "yes", "yes"]
    return folder, play(
        cell, "--session", folder / "s", "--apply", folder / "new.yaml", lines=lines
    )


@pytest.mark.slow
def test_what_is_missing_is_offered_and_fitted_on_a_yes(ended: tuple[Path, Played]) -> None:
    folder, played = ended
    assert played.code == 0, played.err
    assert "poses ask for transmission_error_2 as well. Fit again with it?" in played.out
    offered, judged = played.out.index("Fit again"), played.out.index("poses to verify:")
    assert offered < judged  # the held-out poses are looked at once, by what is written
    assert played.out.count("poses to verify:") == 1
    found = [t for t in load_cell(folder / "new.yaml").model.terms if t.effect == WAVE.effect]
    second = next(t for t in found if t.site == WAVE.site)
    assert second.values == pytest.approx(WAVE.values, abs=1.2e-4)


@pytest.mark.slow
def test_the_cell_that_comes_of_it_predicts_the_arm(ended: tuple[Path, Played]) -> None:
    folder, _ = ended
    plan = plan_in(folder / "s")
    predicted = there(plan, load_cell(folder / "new.yaml").model)
    off = np.linalg.norm(register(there(plan), predicted).in_base(there(plan)) - predicted, axis=1)
    assert off.max() < 1e-4


@pytest.mark.slow
def test_the_cell_says_where_it_comes_from_and_how_well_it_is_known(
    ended: tuple[Path, Played],
) -> None:
    folder, _ = ended
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
