"""Cases of the position channel: a session of a real arm with known causes, or with none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from benchmarks.blind import draws
from benchmarks.blind.bench import Bench, all_clear, combined, draw_bench, size
from benchmarks.blind.draws import Redraw
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.label import Cause
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Array, RealArm, stand
from benchmarks.blind.random_arms import draw_arm
from benchmarks.blind.session import Plan
from benchmarks.blind.writing import write_cell, write_log

MANY = 3  # effects; with more, each sits at one joint


@dataclass(frozen=True)
class Drawn:
    """A cell with its causes: everything from which data and label follow."""

    bench: Bench
    parts: tuple[Ingredient, ...]
    real: RealArm

    def shown_rms(self, gap: Array) -> float:
        """Return a whitened gap, frame taken out, in m rms per coordinate."""
        shown = without(self.bench.frame(), gap)
        position = shown.reshape(len(self.bench.session.q), -1)[:, :3]
        return float(np.sqrt(np.mean(position**2))) * self.bench.floor


def draw_plan(rng: Generator, poses: int = 70) -> Plan:
    """Return a well laid out session."""
    return Plan(
        poses=poses,
        blocks=int(rng.integers(3, 6)),
        pulled=float(rng.uniform(0.15, 0.35)),
        approach_written=bool(rng.random() < 0.6),
        reference_temperature=25.0 if rng.random() < 0.7 else 20.0,
    )


@dataclass(frozen=True)
class StaticDraw:
    """What a static case must be like; what is left open is drawn."""

    effects: tuple[str, ...]
    plan: Plan | None = None
    sigma: float = 2e-5  # m, the tracker
    floor: tuple[float, float] = (2.2e-5, 4.5e-5)  # m, tracker and repeatability
    joints: dict[str, list[int]] | None = None  # of effects that sit at joints
    ratio: float | None = None  # gap over floor of each part
    clear: bool = True  # each part stands clear of the others
    freedom: float | None = None  # of Student's t, where the noise has long tails
    any_arm: bool = False  # an arm drawn at random, of no class


def draw_static(asked: StaticDraw, rng: Generator) -> Drawn:
    """Return a cell whose real arm has these effects, each clear of the others."""
    soft = True if set(asked.effects) & set(draws.NEEDS_COMPLIANCE) else None
    for _ in range(200):
        bench = draw_bench(
            rng, asked.plan or draw_plan(rng), compliant=soft, sigma=asked.sigma,
            target_floor=asked.floor, drawing=draw_arm(rng) if asked.any_arm else None,
        )  # fmt: skip
        if asked.freedom is not None:
            bench = replace(bench, instrument=replace(bench.instrument, freedom=asked.freedom))
        try:
            bench, parts = draw_parts(bench, asked, rng)
        except Redraw:
            continue
        if parts and asked.clear and not all_clear(bench, parts):
            continue
        return Drawn(bench, tuple(parts), combined(bench, parts))
    raise RuntimeError(f"no clear draw of {asked.effects} in 200")


def _places(effect: str, asked: StaticDraw, bench: Bench, rng: Generator) -> list[int] | list[None]:
    """Return the joints that an effect is put at."""
    if effect not in draws.PER_JOINT:
        return [None]
    count = int(rng.choice([1, 2, 3], p=[0.55, 0.3, 0.15]))
    most = 1 if asked.ratio is not None else 3 if len(asked.effects) == 1 else 2
    most = 1 if len(asked.effects) > MANY else most
    chosen = [int(j) for j in rng.permutation(draws.sites(effect, bench.kind))]
    return sorted((asked.joints or {}).get(effect, chosen[: min(count, most)]))


def draw_parts(bench: Bench, asked: StaticDraw, rng: Generator) -> tuple[Bench, list[Ingredient]]:
    """Return the parts, sized. The nominal axial compliance of a stiffening joint is taken out."""
    parts: list[Ingredient] = []
    for effect in asked.effects:
        low, high = draws.RATIO.get(effect, (3.0, 18.0))
        for joint in _places(effect, asked, bench, rng):
            if effect == "stiffness_nonlinearity" and joint is not None:
                bench = _stiff_about(bench, joint)
            for part in draws.draw(
                effect, joint, bench.kind, bench.nominal, bench.session,
                bench.instrument.sigma_turn is not None, rng,
            ):  # fmt: skip
                ratio = float(np.exp(rng.uniform(np.log(low), np.log(high))))
                parts.append(size(bench, part, asked.ratio or ratio))
    return bench, parts


def _stiff_about(bench: Bench, joint: int) -> Bench:
    """Return the bench whose model holds this joint stiff about its axis: no linear part twice."""
    axial = bench.nominal.axial.copy()
    axial[joint - 1] = 0.0
    nominal = replace(bench.nominal, axial=axial)
    return replace(bench, nominal=nominal, model=stand(nominal, bench.session))


def causes_of(parts: tuple[Ingredient, ...]) -> tuple[Cause, ...]:
    """Return the label's causes: parts of one effect put together."""
    out: list[Cause] = []
    for effect in dict.fromkeys(p.effect for p in parts):
        own = [p for p in parts if p.effect == effect]
        joints = tuple(sorted({p.joint for p in own if p.joint is not None}))
        values = {n: float(v) for p in own for n, v in zip(p.names, p.values, strict=True)}
        out.append(Cause(effect, joints, values))
    return tuple(out)


def _elsewhere(bench: Bench, position: Array, rotation: Array | None) -> tuple[Array, Array | None]:
    """Return readings as the tracker gives them from where it stands in each session."""
    position, rotation = position.copy(), None if rotation is None else rotation.copy()
    first = bench.instrument
    for s, (R, p) in enumerate(bench.stations, 1):
        own, change = bench.session_of == s, R @ first.rotation.T
        position[own] = (position[own] - first.position) @ change.T + p
        if rotation is not None:
            rotation[own] = (Rotation.from_matrix(change) * Rotation.from_rotvec(rotation[own])
                             ).as_rotvec()  # fmt: skip
    return position, rotation


def write_static(
    folder: Path, drawn: Drawn, rng: Generator, measured: tuple[Array, Array | None]
) -> dict[str, str | float | bool]:
    """Write log.csv and cell.yaml; return how they were laid out."""
    bench, session = drawn.bench, drawn.bench.session
    folder.mkdir(parents=True, exist_ok=True)
    position, rotation = measured
    columns: dict[str, Array] = {"timestamp": session.time}
    if rng.random() < 0.3:
        columns["target_q"] = session.q + rng.normal(0, 1e-5, session.q.shape)
    columns["actual_q"] = session.q
    constant = np.ptp(session.payload_mass) == 0
    if not (constant and rng.random() < 0.5):
        columns["payload"] = session.payload_mass
        columns["payload_cog"] = session.payload_cog
    if np.any(session.tcp_wrench) or rng.random() < 0.5:
        columns["actual_TCP_force"] = session.tcp_wrench
    columns["joint_temperatures"] = session.temperature
    if bench.plan.approach_written:
        columns["approach"] = session.approach
    columns["measured_position"] = position
    if rotation is not None:
        columns["measured_rotation"] = rotation
    if bench.stations:
        columns["session"] = bench.session_of.astype(float)
        position, rotation = _elsewhere(bench, position, rotation)
        columns["measured_position"] = position
        if rotation is not None:
            columns["measured_rotation"] = rotation
    if bench.plan.doubled:
        columns = {name: np.repeat(column, 2, axis=0) for name, column in columns.items()}
        columns["timestamp"][1::2] += 1.0
    write_log(folder / "log.csv", columns)
    metrology: dict[str, float | bool] = {
        "registered": bench.instrument.registered, "sigma": bench.instrument.sigma,
    }  # fmt: skip
    stated = bool(rng.random() < 0.25)
    if stated:
        extra = float(np.sqrt(bench.floor**2 - bench.instrument.sigma**2))
        metrology["repeatability"] = float(f"{extra:.3g}")
    load = (float(session.payload_mass[0]), session.payload_cog[0])
    write_cell(folder, bench.kind, bench.nominal, load, metrology)
    return {
        "registered": bench.instrument.registered,
        "rotations": rotation is not None,
        "compliant": bool(np.any(bench.nominal.axial)),
        "approach_written": bench.plan.approach_written,
        "repeatability_given": stated,
        "poses": len(session.q),
    }
