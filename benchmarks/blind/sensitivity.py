"""How small an effect is still found, beside what the data can give at most (Cramér-Rao)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.blind.bench import derivatives
from benchmarks.blind.cases import Static, draw_case, generator_of
from benchmarks.blind.measuring import without
from benchmarks.blind.score import CaseScore

RATIOS = (2.0, 1.4, 1.0, 0.7, 0.5, 0.35, 0.25)
SURE = 3.6  # standard deviations at which a 5 % test finds an effect 95 times in 100
WANTED = 0.95


@dataclass(frozen=True)
class Sensitivity:
    """One effect: gap over noise floor, both rms per coordinate."""

    effect: str
    found: dict[float, float]  # gap over floor: share of cases named
    smallest: float | None  # gap over floor found in 95 %; None: not even the largest tried
    bound: float  # gap over floor at which the best estimator's value is SURE deviations


def cramer_rao(effect: str, seeds: Sequence[int]) -> float:
    """Return the gap over floor at which no unbiased estimate is worse than 1 in SURE, median."""
    found = []
    for seed in seeds:
        kind = f"size:{effect}@1.0"
        case = draw_case(kind, generator_of(kind, seed))
        assert isinstance(case, Static)
        bench, parts = case.drawn.bench, list(case.drawn.parts)
        columns = without(bench.frame(), np.column_stack(derivatives(bench, parts)))
        values = np.array([v for p in parts for v in p.values])
        kept = np.abs(values) > 0
        columns = columns[:, kept] * values[kept]  # derivatives by relative size
        spread = np.sqrt(np.diag(np.linalg.pinv(columns.T @ columns, rcond=1e-12)))
        found.append(SURE * float(spread.min()))
    return float(np.median(found))


def sensitivity(
    effect: str, seeds: Sequence[int], run: Callable[[str, int], CaseScore],
    ratios: Sequence[float] = RATIOS,
) -> Sensitivity:  # fmt: skip
    """Return how an effect fares as it shrinks; stops where it is found less than half the time."""
    found: dict[float, float] = {}
    smallest = None
    for ratio in sorted(ratios, reverse=True):
        scores = [run(f"size:{effect}@{ratio}", s) for s in seeds]
        found[ratio] = float(np.mean([s.ok for s in scores]))
        if found[ratio] >= WANTED and (smallest is None or ratio < smallest):
            smallest = ratio
        if found[ratio] < 0.5:
            break
    return Sensitivity(effect, found, smallest, cramer_rao(effect, seeds))
