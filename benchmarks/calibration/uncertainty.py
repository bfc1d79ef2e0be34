"""Does the uncertainty budget keep its word? ``python -m benchmarks.calibration.uncertainty``.

Sessions on all arms of the blind benchmark; each calibrated arm is then sent to poses that it was
not fitted on, and the place where it really comes to rest is compared with where its model puts it.
Truth by mechanics that share nothing with the model. Counted: coordinates within the expanded
uncertainty (k = 2), and poses within the radius that the budget states for 95 %. The budget holds
type A alone: no error of an instrument's scale and no warmth is simulated, so none is stated.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.blind.arms import ARMS
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.budget.budget import budget
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.metrology import Metrology

REPEATED = {"few repeats": 3, "many repeats": 12}
AWAY = 60  # poses that judge the budget


@dataclass(frozen=True)
class Outcome:
    """How one session's budget stands against the truth."""

    arm: str
    repeats: str
    inside: float  # share of coordinates within k = 2
    within: float  # share of poses within the radius for 95 %
    combined: float  # m, stated
    seen: float  # m, rms of one coordinate
    doubtful: bool


def run(arm: str, repeats: str, seed: int) -> Outcome:
    """Return the outcome of one session."""
    rng = np.random.default_rng([seed, 4411])
    kind, layout = ARMS[arm], laid_out.Layout(registered=True, repeated=REPEATED[repeats])
    model = model_of(real_arm(kind))
    parameters = identifiable_parameters(
        model, observable=make_observable("position", registered=True)
    )
    real = laid_out.arm_with(kind, laid_out.draw_values(kind, parameters.names, rng))
    instrument = laid_out.instrument_for(kind, layout, rng)
    readings = laid_out.readings_of(real, laid_out.lay_out(kind, layout, rng), instrument, rng)
    metrology = Metrology(True, layout.sigma)
    found = evaluate_fit(model, fit_session(readings, parameters, metrology), diagnose=False)
    given = budget(found)
    # the arm alone: it comes to rest as it repeats, seen by an instrument without noise
    visits = laid_out.lay_out(kind, replace(layout, held_out=AWAY), rng)
    there = laid_out.readings_of(real, visits, replace(instrument, sigma=0.0), rng)
    away = there[there.held_out]
    error = away.value - found.model.predict(away.q, away.loads).position
    return Outcome(
        arm, repeats, float(np.mean(np.abs(error) <= given.expanded)),
        float(np.mean(np.linalg.norm(error, axis=1) <= given.expanded_length)), given.combined,
        float(np.sqrt(np.mean(error**2))), given.doubtful,
    )  # fmt: skip


def summary(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Return shares over all sessions, by arm and by repeats."""
    groups: dict[str, list[Outcome]] = {"all": list(outcomes)}
    for o in outcomes:
        groups.setdefault(o.arm, []).append(o)
        groups.setdefault(o.repeats, []).append(o)
    return {
        name: {
            "sessions": float(len(own)),
            "coordinates_inside": float(np.mean([o.inside for o in own])),
            "poses_within": float(np.mean([o.within for o in own])),
            "stated_over_seen": float(np.median([o.combined / o.seen for o in own])),
            "doubtful": float(np.mean([o.doubtful for o in own])),
        }
        for name, own in groups.items()
    }


@click.command()
@click.option("--sessions", default=60, show_default=True, help="Sessions, over all arms.")
@click.option("--seed", default=0, show_default=True, help="First seed.")
@click.option("--json", "out", type=click.Path(path_type=Path), default=None, help="Write figures.")
def main(sessions: int, seed: int, out: Path | None) -> None:
    """Count how often tools are where budgets say."""
    console = Console()
    settings = [(arm, repeats) for arm in ARMS for repeats in REPEATED]
    outcomes = [
        run(*settings[i % len(settings)], seed + i)
        for i in track(range(sessions), "sessions", console=console)
    ]
    reported = summary(outcomes)
    table = Table("", *next(iter(reported.values())))
    for name, row in reported.items():
        table.add_row(name, *(f"{value:.3g}" for value in row.values()))
    console.print(table)
    if out:
        out.write_text(json.dumps(reported, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
