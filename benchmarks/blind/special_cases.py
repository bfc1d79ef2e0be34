"""Cases beside the plain ones: effects in no catalogue, hard data, badly excited data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from benchmarks.blind.bench import Bench, draw_bench
from benchmarks.blind.draws import some_effects
from benchmarks.blind.measuring import read_arm, without
from benchmarks.blind.mechanics import Array, RealArm, Session
from benchmarks.blind.outside import NEED_COMPLIANCE, OUTSIDE, Outside
from benchmarks.blind.remainders import REMAINDERS
from benchmarks.blind.session import Plan
from benchmarks.blind.static_cases import Drawn, StaticDraw, draw_plan, draw_static
from benchmarks.blind.twins import columns_of, singles

HARD_SIGMA = 5e-5
BAD = ("no_reversals", "one_load", "few_joints", "tiny_range")
UNLIKE = 100.0  # chi-square that any single effect of the catalogue must leave


@dataclass(frozen=True)
class Strange:
    """A cell with an effect outside the catalogue."""

    drawn: Drawn
    outside: Outside
    strength: float
    gap: Array  # whitened, the frame not taken out
    known_gap: Array | None = None  # of the known effects alone, in a mixed case

    @property
    def misread(self) -> Callable[[Session, Array], Array] | None:
        """Return what the tracker reads instead of true positions, where it errs."""
        read = self.outside.read
        if read is None:
            return None
        return lambda session, position: read(session, position, self.strength)


def draw_outside(name: str, rng: Generator) -> Strange:
    """Return a cell with this effect, unlike any single effect of the catalogue."""
    soft = True if name in NEED_COMPLIANCE else None
    for _ in range(100):
        bench = draw_bench(rng, draw_plan(rng), compliant=soft)
        outside = (OUTSIDE.get(name) or REMAINDERS[name])(bench, rng)
        ratio = float(np.exp(rng.uniform(*np.log(outside.ratio))))
        strength = outside.first
        for _step in range(2):
            gap = outside_gap(bench, outside, strength)
            shown = without(bench.frame(), gap).reshape(len(bench.session.q), -1)[:, :3]
            strength *= ratio / max(float(np.sqrt(np.mean(shown**2))), 1e-12)
        if abs(strength) > 1e4 * outside.first:
            continue
        gap = outside_gap(bench, outside, strength)
        if unlike_known(bench, gap, bench.frame(), "timestamp" in outside.depends_on):
            real = outside.arm(bench.nominal, strength)
            return Strange(Drawn(bench, (), real), outside, strength, gap)
    raise RuntimeError(f"no clear draw of {name} in 100")


def outside_gap(
    bench: Bench, outside: Outside, strength: float, real: RealArm | None = None
) -> Array:
    """Return the whitened gap of an effect outside the catalogue, misreadings included.

    ``real`` is the arm with the effect in it; left out, the nominal one with this effect alone.
    """
    arm = outside.arm(bench.nominal, strength) if real is None else real
    gap = bench.whitened_gap(arm).reshape(len(bench.session.q), -1)
    if outside.read is not None:
        instrument = bench.instrument
        seen = bench.model.tcp @ instrument.rotation.T + instrument.position
        error = outside.read(bench.session, seen, strength) - seen
        gap[:, :3] += (error @ instrument.rotation) * bench.weights[:3]
    return gap.ravel()


def unlike_known(bench: Bench, gap: Array, beside: Array, in_time: bool) -> bool:
    """Return whether no single effect of the catalogue takes the gap up, ``beside`` (m, k)."""
    for hypothesis in singles(bench, in_time):
        columns = columns_of(bench, [hypothesis], bench.nominal)
        left = without(np.column_stack([beside, columns]), gap)
        if float(left @ left) < UNLIKE:
            return False
    return True


def draw_hard(effects: tuple[str, ...], rng: Generator) -> Drawn:
    """Return a cell seen in 30 poses with 50 um of noise."""
    plan = replace(draw_plan(rng, poses=30), blocks=3)
    return draw_static(StaticDraw(effects, plan, HARD_SIGMA, (5.5e-5, 7e-5)), rng)


LAID_OUT = ("clustered", "student", "doubled")
ONE_OR_TWO = {"one": 1, "two": 2}


def draw_laid_out(name: str, rng: Generator) -> Drawn:
    """Return one known effect: clustered poses, heavy-tailed noise, or duplicated rows."""
    plan = draw_plan(rng)
    if name == "clustered":
        plan = replace(plan, clusters=int(rng.integers(7, 11)))
    elif name == "doubled":
        plan = replace(plan, poses=35, doubled=True, approach_written=True)
    elif name != "student":
        raise ValueError(f"kind: found laid_out:{name}, expected one of {', '.join(LAID_OUT)}")
    freedom = 3.0 if name == "student" else None
    return draw_static(StaticDraw(some_effects(1, rng), plan, freedom=freedom), rng)


def draw_arms(name: str, rng: Generator) -> Drawn:
    """Return one or two known effects of an arm that is drawn at random too."""
    asked = StaticDraw(some_effects(_count(name), rng), any_arm=True)
    return draw_static(asked, rng)


def draw_sessions(name: str, rng: Generator) -> Drawn:
    """Return one or two known effects in two sessions, the tracker elsewhere in each."""
    plan = replace(draw_plan(rng, poses=90), sessions=2)
    return draw_static(StaticDraw(some_effects(_count(name), rng), plan), rng)


def _count(name: str) -> int:
    if name not in ONE_OR_TWO:
        raise ValueError(f"kind: found {name!r}, expected one of {', '.join(ONE_OR_TWO)}")
    return ONE_OR_TWO[name]


def with_outliers(drawn: Drawn, rng: Generator, share: float = 0.03) -> tuple[Array, Array | None]:
    """Return readings of which a share (at least one) is off by millimetres."""
    position, rotation = read_arm(drawn.real, drawn.bench.session, drawn.bench.instrument, rng)
    count = max(1, round(share * len(position)))
    rows = rng.choice(len(position), count, replace=False)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    position[rows] += way * np.exp(rng.uniform(np.log(2e-3), np.log(3e-2), count))[:, None]
    return position, rotation


def draw_bad(name: str, rng: Generator) -> Drawn:
    """Return badly excited data: something that the effect needs does not happen."""
    good = draw_plan(rng)
    if name == "no_reversals":
        return draw_static(StaticDraw(("backlash",), replace(good, both_sides=False)), rng)
    if name == "one_load":
        effect = str(rng.choice(["axial_compliance", "radial_compliance", "link_flexibility"]))
        return draw_static(StaticDraw((effect,), replace(good, blocks=1, pulled=0.0)), rng)
    effect = str(rng.choice(["joint_offset", "axial_compliance", "backlash", "transmission_error"]))
    if name == "few_joints":
        # never the same arm twice in number of joints: all have joints 2 and 3
        moving = (1, int(rng.integers(2, 6)))
        joint = int(rng.choice(moving)) + 1
        plan = replace(good, moving=moving, approach_written=True)
        return draw_static(StaticDraw((effect,), plan, joints={effect: [joint]}), rng)
    if name == "tiny_range":
        return draw_static(
            StaticDraw((effect,), Plan(poses=70, blocks=1, pulled=0.0, span=0.08)), rng
        )
    raise ValueError(f"kind: found bad:{name}, expected one of {', '.join(BAD)}")
