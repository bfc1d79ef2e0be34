"""Mixed cases of the position channel: one to three known effects and an unknown remainder.

The remainder is from half to one and a half times as large as a known effect (their geometric
mean). Every known effect stands clear of the others and of the remainder, and is six sigmas large
to one who takes the remainder for noise. The remainder stands clear of the known effects and of any
further one of the catalogue. The log leaves out whole regions of joint space.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.random import Generator

from benchmarks.blind import draws
from benchmarks.blind.bench import CLEAR, Bench, combined, derivatives, draw_bench
from benchmarks.blind.draws import Redraw
from benchmarks.blind.ingredients import Ingredient
from benchmarks.blind.measuring import without
from benchmarks.blind.mechanics import Array
from benchmarks.blind.outside import Outside
from benchmarks.blind.remainders import REMAINDERS
from benchmarks.blind.special_cases import Strange, outside_gap, unlike_known
from benchmarks.blind.static_cases import Drawn, StaticDraw, draw_parts, draw_plan

SIZE = (0.5, 1.5)  # the remainder over a known effect
SHOWN = 36.0  # chi-square of a known effect, the remainder counted as noise
FLOORS = (3.0, 20.0)  # the remainder over the noise
BEYOND = 12  # poses kept back
DRAWS = 150


def draw_mixed(count: int, name: str | None, rng: Generator) -> Strange:
    """Return a cell with ``count`` known effects and a remainder, by name or any."""
    for _ in range(DRAWS):
        effects = draws.some_effects(count, rng)
        soft = True if set(effects) & set(draws.NEEDS_COMPLIANCE) else None
        bench = draw_bench(rng, replace(draw_plan(rng), beyond=BEYOND), compliant=soft)
        try:
            bench, parts = draw_parts(bench, StaticDraw(effects), rng)
            chosen = name or str(rng.choice(list(REMAINDERS)))
            outside = REMAINDERS[chosen](bench, rng)
            strange = _with_remainder(bench, parts, outside, rng)
        except Redraw:
            continue
        if strange is not None:
            return strange
    raise RuntimeError(f"no clear draw of {count} effects beside {name or 'a remainder'} "
                       f"in {DRAWS}")  # fmt: skip


def _with_remainder(
    bench: Bench, parts: list[Ingredient], outside: Outside, rng: Generator
) -> Strange | None:
    """Return the case, or None where something in it could not be found by any test."""
    places = {(p.effect, p.joint) for p in parts}
    if places & {*outside.near, *outside.akin}:
        return None
    frame = bench.frame()
    known = bench.whitened_gap(combined(bench, parts))
    each = [_shown(bench, without(frame, bench.whitened_gap(combined(bench, own))))
            for own in _by_effect(parts)]  # fmt: skip
    usual = float(np.exp(np.mean(np.log(np.maximum(each, 1e-9)))))
    wanted = float(np.clip(usual * rng.uniform(*SIZE), *FLOORS))
    strength = outside.first
    for _ in range(2):
        own = outside_gap(bench, outside, strength)
        strength *= wanted / max(_shown(bench, without(frame, own)), 1e-12)
    if abs(strength) > 1e4 * outside.first:
        return None
    real = outside.arm(combined(bench, parts), strength)
    gap = outside_gap(bench, outside, strength, real)
    unknown = (gap - known)[:, None]
    columns = derivatives(bench, parts)
    for i in range(len(parts)):
        alone = known - bench.whitened_gap(combined(bench, parts[:i] + parts[i + 1 :]))
        others = np.column_stack([frame, unknown, *columns[:i], *columns[i + 1 :]])
        left = without(others, alone)
        if float(left @ left) < max(CLEAR, SHOWN * (1 + wanted**2)):
            return None
    beside = np.column_stack([frame, *columns])
    if not unlike_known(bench, unknown[:, 0], beside, "timestamp" in outside.depends_on):
        return None
    return Strange(Drawn(bench, tuple(parts), real), outside, float(strength), gap, known)


def _by_effect(parts: list[Ingredient]) -> list[list[Ingredient]]:
    return [[p for p in parts if p.effect == e] for e in dict.fromkeys(p.effect for p in parts)]


def _shown(bench: Bench, gap: Array) -> float:
    """Return the rms of a whitened gap's positions, in floors."""
    position = gap.reshape(len(bench.session.q), -1)[:, :3]
    return float(np.sqrt(np.mean(position**2)))
