"""A drawn cell: arm, tool, nominal model, session and instrument, and the sizing of its causes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from benchmarks.blind.arms import ARMS, ArmKind
from benchmarks.blind.draws import Redraw
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.measuring import (
    Instrument,
    floor_of,
    frame_columns,
    gap,
    joint_lever,
    without,
)
from benchmarks.blind.mechanics import Array, RealArm, Session, Shape, stand, turn
from benchmarks.blind.session import Plan, draw_session, parted

CLEAR = 150.0  # what each cause must add to chi-square that nothing else in the case can take up


@dataclass(frozen=True)
class Bench:
    """One cell with its nominal arm and a session in it, before anything is wrong with it."""

    kind: ArmKind
    nominal: RealArm
    session: Session
    plan: Plan
    instrument: Instrument
    model: Shape  # what the nominal model predicts
    floor: float  # m rms per coordinate
    fresh: Session | None = None  # poses of regions that the log does not show
    stations: tuple[tuple[Array, Array], ...] = ()  # frames (R, p) of the sessions after the first

    @property
    def session_of(self) -> NDArray[np.int64]:
        """Return which session each row is of (N,), from 0."""
        count = len(self.session.q)
        return np.arange(count) * (len(self.stations) + 1) // count

    @property
    def weights(self) -> Array:
        """Return 1 / sigma of one row of the gap: (3,) or (6,)."""
        if self.instrument.sigma_turn is None:
            return np.full(3, 1 / self.floor)
        shaken = self.instrument.joint_sigma * np.sqrt(self.kind.n / 3)
        turn_floor = float(np.hypot(self.instrument.sigma_turn, shaken))
        return np.array([1 / self.floor] * 3 + [1 / turn_floor] * 3)

    def whitened_gap(self, arm: RealArm, session: Session | None = None) -> Array:
        """Return the gap of a real arm in units of the noise, flat, the frame not taken out."""
        real = stand(arm, session or self.session)
        model = self.model if session is None else stand(self.nominal, session)
        values = gap(real, model)[:, : len(self.weights)]
        return (values * self.weights).ravel()

    def frame(self) -> Array:
        """Return the whitened columns of the unknown tracker frame (m, 6), or none (m, 0)."""
        columns = frame_columns(self.model, self.instrument.sigma_turn is not None)
        whitened = columns * np.tile(self.weights, len(self.session.q))[:, None]
        if self.stations:  # a frame for each session
            own = np.repeat(self.session_of, len(self.weights))[:, None]
            return np.hstack([whitened * (own == s) for s in range(len(self.stations) + 1)])
        return whitened[:, :0] if self.instrument.registered else whitened


def draw_bench(
    rng: Generator,
    plan: Plan,
    *,
    arm: str | None = None,
    compliant: bool | None = None,
    sigma: float = 2e-5,
    target_floor: tuple[float, float] = (2.2e-5, 4.5e-5),
    with_rotation: bool | None = None,
    drawing: ArmKind | None = None,
) -> Bench:
    """Return a random cell with a session; None leaves a choice to chance."""
    kind = drawing or ARMS[arm or str(rng.choice(list(ARMS)))]
    soft = rng.random() < 0.4 if compliant is None else compliant
    lateral = 0.0 if rng.random() < 0.3 else 0.35
    tool = np.round(kind.tool * np.array([
        rng.normal() * lateral, rng.normal() * lateral, rng.uniform(0.5, 1.5)]), 4)  # fmt: skip
    spread = rng.uniform(0.6, 1.5, (2, kind.n)) if soft else np.zeros((2, kind.n))
    up = -1.0 if rng.random() < 0.9 else 1.0  # some arms hang from the ceiling
    nominal = RealArm(
        rows=kind.rows,
        tool_position=tool,
        tool_rotation=turn(rng.normal(size=(1, 3)).round(2))[0],
        axial=_short(spread[0] * kind.axial),
        radial=_short(spread[1] * kind.radial),
        gravity=np.array([0.0, 0.0, up * 9.80665]),
        reference_temperature=plan.reference_temperature,
    )
    fresh = None
    if plan.beyond:
        whole = draw_session(kind, replace(plan, poses=plan.poses + plan.beyond), rng)
        session, fresh = parted(whole, plan, rng)
    else:
        session = draw_session(kind, plan, rng)
    model = stand(nominal, session)
    rotated = rng.random() < 0.35 if with_rotation is None else with_rotation
    floor = rng.uniform(*target_floor)
    lever = float((joint_lever(model) ** 2).sum(axis=0).mean())
    instrument = Instrument(
        registered=bool(rng.random() < 0.5) and plan.sessions == 1,
        rotation=turn(rng.normal(size=(1, 3)) * 2)[0],
        position=rng.uniform(-3, 3, 3),
        sigma=sigma,
        sigma_turn=float(rng.uniform(3e-5, 1e-4)) if rotated else None,
        joint_sigma=float(np.sqrt(max(floor**2 - sigma**2, 0.0) / lever)),
    )
    if instrument.registered:
        instrument = replace(instrument, rotation=np.eye(3), position=np.zeros(3))
    stations = tuple(
        (turn(rng.normal(size=(1, 3)) * 2)[0], rng.uniform(-3, 3, 3))
        for _ in range(plan.sessions - 1)
    )
    floor = floor_of(model, instrument)
    return Bench(kind, nominal, session, plan, instrument, model, floor, fresh, stations)


def _short(values: Array) -> Array:
    """Return values with four digits, as a cell file would hold them."""
    return np.array([float(f"{v:.4g}") for v in values])


def size(bench: Bench, ingredient: Ingredient, ratio: float) -> Ingredient:
    """Return the ingredient so large that its gap, frame taken out, is ``ratio`` x the floor.

    Raises Redraw where no credible size shows that much.
    """
    frame = bench.frame()
    for _ in range(2):  # twice: not every effect is linear in its size
        shown = without(frame, bench.whitened_gap(ingredient.apply(bench.nominal)))
        by_position = shown.reshape(len(bench.session.q), -1)[:, :3]
        seen = float(np.sqrt(np.mean(by_position**2)))
        if seen < 1e-9:
            raise Redraw
        factor = ratio / seen
        if factor > 1e4:
            raise Redraw
        ingredient = ingredient.scaled(factor)
        if not ingredient.credible():
            raise Redraw
    return ingredient


def combined(bench: Bench, parts: list[Ingredient]) -> RealArm:
    """Return the real arm with all parts in it."""
    arm = bench.nominal
    for part in parts:
        arm = part.apply(arm)
    return arm


def derivatives(bench: Bench, parts: list[Ingredient]) -> list[Array]:
    """Return per part the whitened d gap / d parameter (m, k), at the truth, other parts in."""
    full = combined(bench, parts)
    at = bench.whitened_gap(full)
    out = []
    for i, part in enumerate(parts):
        columns = np.empty((len(at), len(part.values)))
        for k, value in enumerate(part.values):
            step = 1e-4 * (abs(value) or max(abs(v) for v in part.values))
            values = np.array(part.values)
            values[k] += step
            arm = bench.nominal
            for j, other in enumerate(parts):
                arm = other.apply(arm, values if j == i else None)
            columns[:, k] = (bench.whitened_gap(arm) - at) / step
        out.append(columns)
    return out


def all_clear(bench: Bench, parts: list[Ingredient]) -> bool:
    """Return whether each part shows beside the others: nothing else can take its gap up."""
    columns = derivatives(bench, parts)
    full = bench.whitened_gap(combined(bench, parts))
    for i in range(len(parts)):
        alone = full - bench.whitened_gap(combined(bench, parts[:i] + parts[i + 1 :]))
        others = [bench.frame(), *columns[:i], *columns[i + 1 :]]
        left = without(np.column_stack(others), alone)
        if float(left @ left) < CLEAR:
            return False
    return True
