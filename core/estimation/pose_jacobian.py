"""Jacobian of the predicted poses by the parameters of effects, exact, for all rows at once.

An effect gives the derivative of the chain (``Effect.shape_rate``) or of the rows (differences of
``Effect.condition``); one compiled sweep then computes the derivatives of the deflected poses.
Other effects are differentiated numerically, by whole predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import config
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.effects.effect import Effect
from gapbridge.core.kernels.adjoint import CONVERGED
from gapbridge.core.kernels.pose_jacobian import jacobian_blocks
from gapbridge.core.kernels.rates import chain_rate, of_rows, slots
from gapbridge.core.kernels.reference import Chain, Rows
from gapbridge.core.kernels.threads import in_ranges
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses
from gapbridge.core.rotation import rotation_vector

Value = tuple[int, int]  # number of the term in the model, number of the value in the term
Entries = tuple[NDArray[np.int64], NDArray[np.int64], Array]  # starts (p+1), slots, rates


@dataclass(frozen=True)
class PoseColumns:
    """TCP poses of N rows, and their Jacobian by p parameters, base axes."""

    poses: Poses
    jacobian: Array  # (6 or 3, p, N) m and rad per unit: position, then turn


def pose_columns(
    model: Model, q: Array, loads: Loads | None, values: Sequence[Value], steps: Array, *,
    coordinates: int = 6, converged: float = CONVERGED,
) -> PoseColumns:  # fmt: skip
    """Return poses and columns for encoder angles ``q`` (N, n) and some values in the model.

    ``steps`` (p,): step of each value for numerical derivatives. ``coordinates``: 3 for positions
    alone; ``converged``: largest change of a derivative in the last round, m per rad of deflection.
    Raises InputError where a row has no equilibrium.
    """
    loads = loads or Loads()
    jacobian = np.empty((coordinates, len(values), len(q)))
    chain, rows = model.chain(), model.rows(q, loads)
    rates, known = _chain_rates(model, chain, values)
    varying, first_order_ok = _row_rates(model, q, loads, values, steps)
    poses = None
    if not _has_steps(model, loads):
        poses = _sweep(chain, rows, (_entries(rates), varying), jacobian, converged)
    if poses is None:
        poses, known = model.predict(q, loads), np.zeros(len(values), dtype=bool)
    for c in np.flatnonzero(~(known & first_order_ok)).tolist():
        change = _difference(model, q, loads, values[c], float(steps[c]))
        jacobian[:, c] = change[:coordinates]
    return PoseColumns(poses, jacobian)


def _chain_rates(model: Model, chain: Chain, values: Sequence[Value]) -> tuple[Array, Mask]:
    """Return the slots' rates (p, slots), and which parameters' are known (p,)."""
    n = model.arm.n
    rates, known = np.zeros((len(values), slots(n))), np.ones(len(values), dtype=bool)
    for c, (t, k) in enumerate(values):
        term = model.terms[t]
        effect = CATALOGUE[term.effect]
        if type(effect).shape is not Effect.shape:
            known[c] = effect.shape_rate(term, model.arm, chain, k, chain_rate(n, rates[c]))
    return rates, known


def _entries(rates: Array) -> Entries:
    """Return the nonzero entries of rates (p, slots)."""
    column, slot = np.nonzero(rates)  # strided views: made contiguous, to compile one signature
    starts = np.searchsorted(column, np.arange(len(rates) + 1))
    return starts, np.ascontiguousarray(slot), rates[column, slot]


def _row_rates(
    model: Model, q: Array, loads: Loads, values: Sequence[Value], steps: Array
) -> tuple[Entries, Mask]:
    """Return the derivatives of the rows (entries, N), and which parameters they cover (p,)."""
    n, terms, base = model.arm.n, model.conditions(), Effect.condition
    first_order_ok = np.ones(len(values), dtype=bool)
    if not terms:  # no effect changes the rows
        nothing = np.zeros(len(values) + 1, dtype=np.int64)
        return (nothing, np.zeros(0, dtype=np.int64), np.zeros((0, len(q)))), first_order_ok
    without_terms = model.without_terms().rows(q, loads)
    starts, slots, changes = [0], [], []
    for c, (t, k) in enumerate(values):
        if type(CATALOGUE[model.terms[t].effect]).condition is not base:
            ends = []
            for step in (steps[c], -steps[c]):
                moved = _with_step(model, t, k, float(step)).terms[t]
                ends.append(Rows(*(part.copy() for part in without_terms)))
                model.condition(
                    ends[-1], loads, q, [moved if o is model.terms[t] else o for o in terms]
                )
            one, other = ends
            first_order_ok[c] = all(
                np.array_equal(a, b) for a, b in zip(one[3:], other[3:], strict=True)
            )
            change = np.column_stack([a - b for a, b in zip(one[:3], other[:3], strict=True)])
            for j in np.flatnonzero(change.any(axis=0)):
                slots.append(of_rows(n) + j)
                changes.append(change[:, j] / (2 * steps[c]))
        starts.append(len(changes))
    rates = np.array(changes) if changes else np.zeros((0, len(q)))
    return (np.array(starts), np.array(slots, dtype=np.int64), rates), first_order_ok


def _has_steps(model: Model, loads: Loads) -> bool:
    """Return whether an effect changes the poses of rows before a moment."""
    base = Effect.before
    steps = any(type(CATALOGUE[t.effect]).before is not base for t in model.terms)
    return steps and loads.time is not None


def _sweep(
    chain: Chain, rows: Rows, entries: tuple[Entries, Entries], jacobian: Array, converged: float
) -> Poses | None:
    """Write the derivatives (3 or 6, p, N) and return the poses; None if the sweep cannot do so."""
    if bool(chain.flexibility.any()) or bool(getattr(config, "DISABLE_JIT", 0)):
        return None
    count = len(rows.q)
    results = np.empty((count, 3)), np.empty((count, 3, 3)), jacobian

    def work(first: int, last: int) -> int:
        return int(jacobian_blocks(chain, rows, entries, first, last, results, converged))

    if any(bad >= 0 for bad in in_ranges(work, count)):
        return None
    return Poses(*results[:2])


def _with_step(model: Model, t: int, k: int, step: float) -> Model:
    """Return the model with one value of one term changed."""
    term = model.terms[t]
    values = [v + step if i == k else v for i, v in enumerate(term.values)]
    terms = (*model.terms[:t], replace(term, values=tuple(values)), *model.terms[t + 1 :])
    return replace(model, terms=terms)


def _difference(model: Model, q: Array, loads: Loads, value: Value, step: float) -> Array:
    """Return one column (6, N) by central differences of whole predictions."""
    one, other = (
        _with_step(model, *value, sign_step).predict(q, loads) for sign_step in (step, -step)
    )
    rotation = rotation_vector(one.rotation @ np.swapaxes(other.rotation, 1, 2))
    return np.hstack([one.position - other.position, rotation]).T / (2 * step)
