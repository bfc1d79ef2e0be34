"""Optimal choice of readings by exchange, with low-rank updates of the information matrix.

The criterion is the weighted mean variance of the predicted TCP (I-optimality). The first readings
are chosen for the volume of the confidence region (D-optimality), which is defined without prior
information. Source: Atkinson, Donev, Tobias, Optimum Experimental Designs (2007), ch. 10-12;
Fedorov's exchange.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.planning.information import information_of, inverse

CONVERGED = 2e-3  # relative gain of a whole round of exchanges that ends the search
MIN_GAIN = 1e-6  # in the logarithm of the criterion
ROUNDS = 6

Cost = Callable[[Sequence[int]], Array]


@dataclass(frozen=True)
class Choice:
    """The equations of the candidates (R, k, P), and the criterion for a choice of them."""

    rows: Array  # (R, k, P) equations of each candidate
    root: Array  # (P, r) W = root @ root.T is the weight of the covariance
    cost: Cost  # of adding each candidate (R,) to a choice, in logarithms of a standard deviation

    @classmethod
    def of(cls, rows: Array, weight: Array, cost: Cost) -> Choice:
        """Return the choice for a weight (P, P) of the covariance."""
        values, vectors = np.linalg.eigh(weight)
        kept = values > 1e-12 * values[-1]
        return cls(np.ascontiguousarray(rows), vectors[:, kept] * np.sqrt(values[kept]), cost)

    def value(self, chosen: Sequence[int]) -> float:
        """Return the expected rms error of the TCP (m)."""
        covariance = inverse(information_of(self.rows[list(chosen)]))
        return float(np.sqrt(np.sum(self.root * (covariance @ self.root))))

    def gains(self, chosen: Sequence[int]) -> Array:
        """Return the logarithm of the criterion (R,) after adding each candidate, plus its cost."""
        S, HS, inner = self._update_terms(chosen)
        now = float(np.sum(self.root * (S @ self.root)))
        kept = (HS @ self.root).reshape(*self.rows.shape[:2], -1)
        spread = kept @ np.swapaxes(kept, 1, 2)
        fall = np.einsum("rij,rji->r", np.linalg.inv(inner), spread)
        score = 0.5 * np.log(np.maximum(now - fall, 1e-6 * now)) + self.cost(chosen)
        return self._exclude(score, chosen)

    def volumes(self, chosen: Sequence[int]) -> Array:
        """Return the change of the covariance's log volume per parameter (R,), plus the cost."""
        inner = self._update_terms(chosen)[2]
        score = -0.5 * np.linalg.slogdet(inner)[1] / self.rows.shape[2] + self.cost(chosen)
        return self._exclude(score, chosen)

    def _update_terms(self, chosen: Sequence[int]) -> tuple[Array, Array, Array]:
        """Return covariance S, rows @ S (R*k, P), and 1 + row S row^T (R, k, k)."""
        count, k, size = self.rows.shape
        S = inverse(information_of(self.rows[list(chosen)]))
        HS = self.rows.reshape(-1, size) @ S
        inner = HS.reshape(count, k, size) @ np.swapaxes(self.rows, 1, 2)
        return S, HS, np.asarray(np.eye(k) + inner)

    def _exclude(self, score: Array, chosen: Sequence[int]) -> Array:
        score[list(chosen)] = np.inf
        return score


def forward_selected(choice: Choice, chosen: Sequence[int], count: int, volume: int) -> list[int]:
    """Return a choice of ``count`` by greedy forward selection, the first ``volume`` D-optimal."""
    selected = list(chosen)
    while len(selected) < count:
        score = choice.volumes(selected) if len(selected) < volume else choice.gains(selected)
        best = int(np.argmin(score))
        if not np.isfinite(score[best]):
            break
        selected.append(best)
    return selected


def exchanged(
    choice: Choice,
    chosen: Sequence[int],
    rounds: int = ROUNDS,
    report: Callable[[float], None] | None = None,
) -> list[int]:
    """Return the choice after rounds of exchanging each member for the best candidate."""
    selected = list(chosen)
    for number in range(rounds):
        before = choice.value(selected)
        for index in range(len(selected)):
            others = selected[:index] + selected[index + 1 :]
            score = choice.gains(others)
            best = int(np.argmin(score))
            if score[best] < score[selected[index]] - MIN_GAIN:
                selected[index] = best
            if report:
                report((number + (index + 1) / len(selected)) / rounds)
        if choice.value(selected) > (1 - CONVERGED) * before:
            break
    return selected


def backward_eliminated(choice: Choice, chosen: Sequence[int], count: int) -> list[int]:
    """Return ``count`` of the chosen, by greedy backward elimination."""
    selected = list(chosen)
    while len(selected) > count:
        values = [choice.value(selected[:i] + selected[i + 1 :]) for i in range(len(selected))]
        selected.pop(int(np.argmin(values)))
    return selected
