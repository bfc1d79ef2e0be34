"""Optimal choice of readings by exchange, with low-rank updates of the information matrix.

The criterion is the weighed mean variance of the predicted TCP (I-optimality); the first readings
are chosen for the volume of the confidence region (D-optimality), which is what a start without any
information needs. Source: Atkinson, Donev, Tobias, Optimum Experimental Designs (2007),
ch. 10-12; Fedorov's exchange.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.planning.information import information_of, inverse

CONVERGED = 2e-3  # relative gain of a whole round of exchanges that ends the search
BETTER = 1e-6  # in the logarithm of the criterion
ROUNDS = 6

Cost = Callable[[Sequence[int]], Array]


@dataclass(frozen=True)
class Choice:
    """The candidates (R, k, P), and how a choice of them is judged."""

    rows: Array  # (R, k, P) equations of each candidate
    root: Array  # (P, r) W = root @ root.T weighs the covariance
    cost: Cost  # of adding each candidate (R,) to a choice, in logarithms of a standard deviation

    @classmethod
    def of(cls, rows: Array, weight: Array, cost: Cost) -> Choice:
        """Return the choice for a weight (P, P) of the covariance."""
        values, vectors = np.linalg.eigh(weight)
        seen = values > 1e-12 * values[-1]
        return cls(np.ascontiguousarray(rows), vectors[:, seen] * np.sqrt(values[seen]), cost)

    def value(self, chosen: Sequence[int]) -> float:
        """Return the expected rms error of the TCP (m)."""
        covariance = inverse(information_of(self.rows[list(chosen)]))
        return float(np.sqrt(np.sum(self.root * (covariance @ self.root))))

    def gains(self, chosen: Sequence[int]) -> Array:
        """Return the logarithm of the criterion (R,) after adding each candidate, costs in it."""
        S, HS, inner = self._inner(chosen)
        now = float(np.sum(self.root * (S @ self.root)))
        seen = (HS @ self.root).reshape(*self.rows.shape[:2], -1)
        spread = seen @ np.swapaxes(seen, 1, 2)
        fall = np.einsum("rij,rji->r", np.linalg.inv(inner), spread)
        score = 0.5 * np.log(np.maximum(now - fall, 1e-6 * now)) + self.cost(chosen)
        return self._new(score, chosen)

    def volumes(self, chosen: Sequence[int]) -> Array:
        """Return the fall of the covariance's log volume (R,), a parameter; smaller is better."""
        inner = self._inner(chosen)[2]
        score = -0.5 * np.linalg.slogdet(inner)[1] / self.rows.shape[2] + self.cost(chosen)
        return self._new(score, chosen)

    def _inner(self, chosen: Sequence[int]) -> tuple[Array, Array, Array]:
        """Return covariance S, rows @ S (R*k, P), and 1 + row S row^T (R, k, k)."""
        count, k, size = self.rows.shape
        S = inverse(information_of(self.rows[list(chosen)]))
        HS = self.rows.reshape(-1, size) @ S
        inner = HS.reshape(count, k, size) @ np.swapaxes(self.rows, 1, 2)
        return S, HS, np.asarray(np.eye(k) + inner)

    def _new(self, score: Array, chosen: Sequence[int]) -> Array:
        score[list(chosen)] = np.inf
        return score


def forward_selected(choice: Choice, chosen: Sequence[int], count: int, volume: int) -> list[int]:
    """Return a choice of ``count``, the best added in turn: the first ``volume`` by the volume."""
    found = list(chosen)
    while len(found) < count:
        score = choice.volumes(found) if len(found) < volume else choice.gains(found)
        best = int(np.argmin(score))
        if not np.isfinite(score[best]):
            break
        found.append(best)
    return found


def exchanged(
    choice: Choice,
    chosen: Sequence[int],
    rounds: int = ROUNDS,
    report: Callable[[float], None] | None = None,
) -> list[int]:
    """Return the choice after each of its members was offered a better place, round by round."""
    found = list(chosen)
    for number in range(rounds):
        begin = choice.value(found)
        for place in range(len(found)):
            rest = found[:place] + found[place + 1 :]
            score = choice.gains(rest)
            best = int(np.argmin(score))
            if score[best] < score[found[place]] - BETTER:
                found[place] = best
            if report:
                report((number + (place + 1) / len(found)) / rounds)
        if choice.value(found) > (1 - CONVERGED) * begin:
            break
    return found


def backward_eliminated(choice: Choice, chosen: Sequence[int], count: int) -> list[int]:
    """Return a choice of ``count`` of the chosen: those that are missed least are given up."""
    found = list(chosen)
    while len(found) > count:
        left = [choice.value(found[:i] + found[i + 1 :]) for i in range(len(found))]
        found.pop(int(np.argmin(left)))
    return found
