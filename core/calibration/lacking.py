"""What a calibration lacks: effects that were not asked for and that its remainder speaks of.

Each further effect is tried beside all parameters, which move along: what it would take off the
remainder counts, not how it looks beside values that have swallowed a part of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.problem import Problem
from gapbridge.core.calibration.rest import Rest
from gapbridge.core.effects import CATALOGUE

Array = NDArray[np.float64]
TOLD = 3  # effects at most
SURE = 6.0  # how much more likely (log) than nothing, the number of effects tried paid for
SMALL = 0.05  # share of the remainder below which an effect is not worth reporting
SHOWN = 1e-6  # share of a column that the parameters leave of it, below which it is one of them


@dataclass(frozen=True)
class Lack:
    """An effect that would explain a part of what is left."""

    name: str  # as Parameters.of takes it: backlash_3, thermal_drift
    share: float  # of the remainder's squares that it takes off


def lacking(problem: Problem, rest: Rest) -> tuple[Lack, ...]:
    """Return the further effects that the remainder speaks of, the strongest first."""
    tried = _columns(problem, rest)
    system = rest.system
    known = np.hstack([system.J, system.F])
    left = system.left
    found: list[Lack] = []
    for _ in range(TOLD):
        Q = _orthonormal(known)
        free = left - Q @ (Q.T @ left)
        whole = float(free @ free)
        spare = max(len(left) - Q.shape[1], 1)
        best: tuple[float, str, float, Array] | None = None
        for name, columns in tried.items():
            if any(name == lack.name for lack in found):
                continue
            own = columns - Q @ (Q.T @ columns)
            seen = np.linalg.norm(own, axis=0) > SHOWN * np.linalg.norm(columns, axis=0)
            own = _orthonormal(own[:, seen])
            if not own.shape[1]:
                continue
            taken = float(np.sum((own.T @ free) ** 2)) / whole
            cost = 0.5 * own.shape[1] * np.log(spare) + np.log(len(tried))
            gain = -0.5 * spare * np.log(max(1 - taken, 1e-12)) - cost
            if best is None or gain > best[0]:
                best = (float(gain), name, taken, columns)
        if best is None or best[0] < SURE or best[2] < SMALL:
            break
        found.append(Lack(best[1], best[2]))
        known = np.hstack([known, best[3]])
    return tuple(found)


def _orthonormal(columns: Array) -> Array:
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0] / size[size > 0]
    U, s, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(U[:, s > 1e-8 * max(float(s.max(initial=0.0)), 1e-300)])


def _columns(problem: Problem, rest: Rest) -> dict[str, Array]:
    """Return the columns (M, k) of every further effect at every site, weighed as the system is."""
    parameters, observable, readings = problem.parameters, problem.observable, problem.readings
    found = parameters.model(rest.values)
    had = {(t.effect, t.site.joint) for t in parameters.terms}
    effects = [e for e, member in CATALOGUE.items() if member.calibratable]
    every = Parameters.every(found, effects)
    J, _ = observable.columns(every, every.begin, readings, rest.nuisance)
    N, k = len(readings), observable.equations
    J = (rest.noise.whitener @ J.reshape(N, k, -1)).reshape(N * k, -1)
    J = J * np.repeat(np.sqrt(rest.weights), k)[:, None]
    columns: dict[str, list[Array]] = {}
    for i, (t, _value) in enumerate(every.place):
        term = every.terms[t]
        if (term.effect, term.site.joint) in had:
            continue
        joint = term.site.joint
        name = term.effect if joint is None else f"{term.effect}_{joint}"
        columns.setdefault(name, []).append(J[:, i])
    return {name: np.column_stack(own) for name, own in columns.items()}
