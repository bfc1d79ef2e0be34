"""Do the intervals hold the truth? ``python -m benchmarks.calibration.coverage --sessions 500``.

Sessions on all arms of the blind benchmark, with positions in an unknown frame, positions in base,
and whole poses. Truth by mechanics that share nothing with the model. Counted: 95 % intervals of
the parameters that the fit calls shown, and of the predicted readings at held-out poses.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path

import click
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.blind.arms import ARMS
from benchmarks.calibration import laid_out
from benchmarks.calibration.drawings import model_of, real_arm
from gapbridge.core.calibration.converged_fit import converged_fit
from gapbridge.core.calibration.fit import make_estimates
from gapbridge.core.calibration.held_out_check import predicted
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

LAYOUTS = {
    "position": laid_out.Layout(),
    "position, registered": laid_out.Layout(registered=True),
    "pose": laid_out.Layout(pose_kind=True),
}


KEPT = 20  # sessions after which the figures so far are written
COLUMNS = ("sessions", "parameters", "readings", "z_rms", "seconds")


@dataclass(frozen=True)
class Setting:
    """One arm under one kind of session."""

    arm: str
    layout: str
    model: Model
    parameters: Parameters


@dataclass(frozen=True)
class Outcome:
    """Which intervals held the truth in one session."""

    arm: str
    layout: str
    parameters: tuple[tuple[str, bool], ...]  # name, held
    readings: tuple[bool, ...]  # coordinates at held-out poses
    z: tuple[float, ...]
    seconds: float


def settings() -> list[Setting]:
    """Return every arm with every layout."""
    found = []
    for arm, kind in ARMS.items():
        model = model_of(real_arm(kind))
        for name, layout in LAYOUTS.items():
            how = make_observable(
                "pose" if layout.pose_kind else "position", registered=layout.registered
            )
            found.append(Setting(arm, name, model, identifiable_parameters(model, observable=how)))
    return found


def run(setting: Setting, seed: int) -> Outcome:
    """Return the outcome of one session."""
    rng = np.random.default_rng([seed, 77])
    kind, layout = ARMS[setting.arm], LAYOUTS[setting.layout]
    truth = laid_out.draw_values(kind, setting.parameters.names, rng)
    real, laid = laid_out.arm_with(kind, truth), laid_out.lay_out(kind, layout, rng)
    instrument = laid_out.instrument_for(kind, layout, rng)
    readings = laid_out.readings_of(real, laid, instrument, rng)
    exact = laid_out.readings_of(real, laid, instrument, None)
    metrology = Metrology(layout.registered, layout.sigma)
    how = make_observable(readings.kind, registered=layout.registered)
    begun = time.perf_counter()
    fitted = readings[~readings.held_out]
    problem, rest = converged_fit(setting.parameters, how, fitted, metrology, lambda text: None)
    seconds = time.perf_counter() - begun
    estimates = make_estimates(setting.parameters, rest, None)
    held = [
        (e.name, bool(e.interval[0] <= truth[e.name] <= e.interval[1]))
        for e in estimates
        if e.shown
    ]
    z = [(e.value - truth[e.name]) / e.std for e in estimates if e.shown]
    away = exact[exact.held_out]
    found = setting.parameters.model(rest.values)
    off = how.residual(found, away, rest.nuisance)
    variance = np.einsum("nii->ni", predicted(problem, rest, away))
    inside = np.abs(off) <= 1.96 * np.sqrt(variance)
    return Outcome(
        setting.arm, setting.layout, tuple(held), tuple(map(bool, inside.ravel())),
        tuple(map(float, z)), seconds,
    )  # fmt: skip


def summary(outcomes: list[Outcome]) -> dict[str, dict[str, float]]:
    """Return shares held over all, and by arm, layout and effect."""
    groups: dict[str, list[Outcome]] = {"all": outcomes}
    for o in outcomes:
        groups.setdefault(o.arm, []).append(o)
        groups.setdefault(o.layout, []).append(o)
    reported = {
        name: {
            "sessions": float(len(own)),
            "parameters": _share([held for o in own for _, held in o.parameters]),
            "readings": _share([held for o in own for held in o.readings]),
            "z_rms": float(np.sqrt(np.mean([z**2 for o in own for z in o.z]))),
            "seconds": float(np.median([o.seconds for o in own])),
        }
        for name, own in groups.items()
    }
    effects: dict[str, list[bool]] = {}
    for o in outcomes:
        for name, held in o.parameters:
            effects.setdefault("_".join(name.split("_")[:2]), []).append(held)
    return reported | {name: {"parameters": _share(held)} for name, held in effects.items()}


def _share(held: list[bool]) -> float:
    return float(np.mean(held)) if held else float("nan")


@click.command()
@click.option("--sessions", default=500, show_default=True, help="Sessions, over all arms.")
@click.option("--seed", default=0, show_default=True, help="First seed.")
@click.option("--json", "out", type=click.Path(path_type=Path), default=None, help="Write figures.")
def main(sessions: int, seed: int, out: Path | None) -> None:
    """Count how often 95 % intervals hold the truth."""
    console, known = Console(), settings()
    outcomes: list[Outcome] = []
    for i in track(range(sessions), "sessions", console=console):
        outcomes.append(run(known[i % len(known)], seed + i))
        if out is not None and len(outcomes) % KEPT == 0:
            _write(out, outcomes)
    reported = summary(outcomes)
    table = Table("", "sessions", "parameters held", "predictions held", "rms z", "s a fit")
    for name, row in reported.items():
        table.add_row(name, *(_cell(row.get(k), k) for k in COLUMNS))
    console.print(table)
    if out is not None:
        _write(out, outcomes)


def _write(out: Path, outcomes: list[Outcome]) -> None:
    out.write_text(json.dumps(summary(outcomes), indent=1), encoding="utf-8")


def _cell(value: float | None, key: str) -> str:
    if value is None:
        return ""
    if key in ("parameters", "readings"):
        return f"{100 * value:.1f} %"
    return f"{value:.0f}" if key == "sessions" else f"{value:.2f}"


if __name__ == "__main__":
    main()
