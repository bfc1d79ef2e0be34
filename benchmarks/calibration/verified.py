"""How near is the arm to its calibrated model? ``python -m benchmarks.calibration.verified``.

Every arm of the blind benchmark, with each effect of the position channel put in beside other
geometry and softness, is calibrated from one session and checked on poses that the fit never saw.
The figure is the held-out error of one coordinate over what no calibration can take away: the
instrument's noise and the arm's repeatability, as they truly were.

With ``--asked`` nobody says what the arm has: the fit begins with the effects that every session
looks for, and is made again with those that it says are missing.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
from numpy.random import Generator
from rich.console import Console
from rich.progress import track
from rich.table import Table

from benchmarks.blind.arms import ARMS
from benchmarks.blind.bench import Bench, combined, draw_bench, size
from benchmarks.blind.draws import PER_JOINT, POSITION_EFFECTS, RATIO, Redraw, draw, sites
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.measuring import joint_lever, read_arm
from benchmarks.blind.mechanics import Array, RealArm, stand
from benchmarks.blind.session import Plan
from benchmarks.calibration.drawings import model_of
from benchmarks.calibration.laid_out import draw_values, with_values
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, PERIODIC_ORDERS, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.loads import Loads
from gapbridge.core.metrology import Metrology

LIMIT = 1.2
FITTED = 90
SESSION = Plan(poses=FITTED + 200, blocks=3, pulled=0.25)  # many to verify: little left to chance
TRIES = 60
REFITS = 3  # times at most that what is missing is added
TITLES = ("", "sessions", "before, mm", "after, mm", "floor, mm", "median", "mean", "largest")


@dataclass(frozen=True)
class Outcome:
    """One calibrated arm."""

    arm: str
    effect: str
    before: float  # m, rms of one coordinate at held-out poses, nominal model
    after: float
    floor: float  # m, instrument and arm, one coordinate, at the same poses
    missing: tuple[str, ...] = ()  # effects that the readings asked for, in turn
    named: bool = True  # what the arm has is among what was fitted

    @property
    def ratio(self) -> float:
        """Return the held-out error over instrument and arm."""
        return self.after / self.floor


def draw_case(arm: str, effect: str, rng: Generator) -> tuple[Bench, list[Ingredient]]:
    """Return a cell and what is wrong with its arm: ``effect`` where it shows, or nothing more."""
    for _ in range(TRIES):
        bench = draw_bench(rng, SESSION, arm=arm)
        if effect == "none":
            return bench, []
        joints = sites(effect, bench.kind) if effect in PER_JOINT else []
        joint = int(rng.choice(joints)) if joints else None
        turned = bench.instrument.sigma_turn is not None
        try:
            drawn = draw(effect, joint, bench.kind, bench.nominal, bench.session, turned, rng)
            ratio = rng.uniform(*RATIO.get(effect, (5.0, 20.0)))
            parts = [size(bench, part, ratio) for part in drawn]
        except Redraw:
            continue
        orders = [float(n.split("order")[1].split("_")[0]) for p in parts for n in p.names[:1]
                  if "order" in n]  # fmt: skip
        if all(order in PERIODIC_ORDERS for order in orders):
            return bench, parts
    raise RuntimeError(f"{arm}: no {effect} shows in {TRIES} draws")


def run(arm: str, effect: str, seed: int, asked: bool = False) -> Outcome:
    """Return the outcome of one arm with one effect among others.

    ``asked``: the fit is not given which, but made again with what it says is missing.
    """
    rng = np.random.default_rng([seed, 4711])
    bench, parts = draw_case(arm, effect, rng)
    model = model_of(bench.nominal)
    turned = bench.instrument.sigma_turn is not None
    how = make_observable("pose" if turned else "position", registered=bench.instrument.registered)
    more = () if effect in (*DEFAULT, "none") else (_named(effect, parts),)
    every = Parameters.of_effects(model, DEFAULT).names
    instead = [f"axial_compliance_{p.joint}" for p in parts if effect == "stiffness_nonlinearity"]
    names = [n for n in every if n not in instead and (turned or "tool_frame_r" not in n)]
    real = with_values(combined(bench, parts), draw_values(bench.kind, names, rng))
    readings = _readings(bench, real, rng)
    metrology = Metrology(bench.instrument.registered, bench.instrument.sigma)
    chosen = () if asked else more

    def fit() -> Calibration:
        parameters = identifiable_parameters(model, (*chosen, *DEFAULT), observable=how, pulls=True)
        return evaluate_fit(
            model, fit_session(readings, parameters, metrology, observable=how), diagnose=False
        )

    found = fit()
    for _ in range(REFITS if asked else 0):
        new = [name for name in found.missing_effects if name not in chosen]
        if not new:
            break
        chosen = (*chosen, *new)
        found = fit()
    before, after = (_coordinate(e.vector) for e in (found.held_out_before, found.held_out_after))
    return Outcome(
        arm, effect, before, after, _floor(bench, real, readings), chosen if asked else (),
        set(more) <= set(chosen),
    )  # fmt: skip


def _named(effect: str, parts: list[Ingredient]) -> str:
    """Return the effect as the fit is given it: at its joint where it has one."""
    joint = parts[0].joint
    return effect if joint is None else f"{effect}_{joint}"


def _readings(bench: Bench, real: RealArm, rng: Generator) -> Readings:
    """Return the session's readings, some poses of every load held out."""
    session = bench.session
    position, rotation = read_arm(real, session, bench.instrument, rng)
    count = len(session.q)
    held_out = np.ones(count, dtype=bool)
    held_out[rng.choice(count, FITTED, replace=False)] = False
    zeros = np.zeros(count, dtype=np.int64)
    return Readings(
        kind="position" if rotation is None else "pose",
        q=session.q,
        value=position if rotation is None else np.hstack([position, rotation]),
        scatter=np.full(count, np.nan),
        loads=Loads(
            session.payload_mass, session.payload_cog, session.tcp_wrench,
            session.temperature, session.approach,
        ),
        load=np.unique(session.payload_mass, return_inverse=True)[1].astype(np.int64),
        station=zeros, target=zeros, held_out=held_out,
        pose=np.arange(count, dtype=np.int64),
    )  # fmt: skip


def _coordinate(gap: Array) -> float:
    return float(np.sqrt(np.mean(gap**2)))


def _floor(bench: Bench, real: RealArm, readings: Readings) -> float:
    """Return instrument and arm, rms of one coordinate, at the held-out poses."""
    lever = (joint_lever(stand(real, bench.session)) ** 2).sum(axis=0)[readings.held_out].mean()
    instrument = bench.instrument
    return float(np.sqrt(instrument.sigma**2 + lever * instrument.joint_sigma**2))


@click.command()
@click.option("--seeds", default=2, show_default=True, help="Sessions of each arm and effect.")
@click.option("--seed", default=0, show_default=True, help="First seed.")
@click.option("--effects", default=",".join(("none", *POSITION_EFFECTS)), help="By commas.")
@click.option("--asked", is_flag=True, help="Fit what the readings ask for, nothing else given.")
@click.option("--json", "out", type=click.Path(path_type=Path), default=None, help="Write figures.")
def main(seeds: int, seed: int, effects: str, asked: bool, out: Path | None) -> None:
    """Calibrate every arm with every effect, and check it on poses that the fit never saw."""
    console = Console()
    chosen = effects.split(",")
    jobs = [(a, e, seed + s) for s in range(seeds) for e in chosen for a in ARMS]
    done = []
    for job in track(jobs, "arms", console=console):
        done.append(run(*job, asked))
        if out is not None:  # what is done is kept, whatever comes after
            rows = [asdict(o) | {"ratio": o.ratio} for o in done]
            out.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    table = Table(*TITLES)
    for name in (*ARMS, *chosen, "all"):
        own = [o for o in done if name in (o.arm, o.effect, "all")]
        table.add_row(name, str(len(own)), *_cells(own))
    console.print(table)
    over = [o for o in done if o.ratio > LIMIT]
    for o in over:
        console.print(f"over {LIMIT}: {o.arm} {o.effect} {o.ratio:.2f}")
    for o in [o for o in done if asked and not o.named]:
        console.print(f"asked for {', '.join(o.missing_effects) or 'nothing'}: {o.arm} {o.effect}")


def _cells(own: list[Outcome]) -> list[str]:
    ratio = np.array([o.ratio for o in own])
    lengths = [1e3 * float(np.median([getattr(o, k) for o in own]))
               for k in ("before", "after", "floor")]  # fmt: skip
    # the mean over sessions is of squares: one session's held-out poses scatter by themselves
    mean = float(np.sqrt(np.mean(ratio**2)))
    return [*(f"{v:.4f}" for v in lengths), f"{np.median(ratio):.2f}", f"{mean:.2f}",
            f"{ratio.max():.2f}"]  # fmt: skip


if __name__ == "__main__":
    main()
