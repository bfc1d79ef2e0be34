"""Local refinement of the chosen poses by gradient descent in joint space.

The candidates of a plan are a coarse sample of joint space. Each chosen pose is moved down the
gradient of the criterion, within limits, obstacles and line of sight.

The aim is minimax: the worst-case accuracy of the TCP over the workspace, not the mean. The maximum
is not smooth, so a weighted mean is minimised instead; after each update the weight of a reference
pose is multiplied by a power of its variance, as in the multiplicative algorithms of optimal design
(Silvey, Titterington, Torsney, Comm. Stat. A7 (1978); Atkinson, Donev, Tobias, Optimum Experimental
Designs (2007), ch. 9).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.planning.candidates import Candidates, measurable
from gapbridge.core.planning.exchange import Choice
from gapbridge.core.planning.information import Reference, information_of, inverse, whitened_rows
from gapbridge.core.workspace.workspace import Workspace

STEP = 0.02  # rad, for the gradient
LENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5)  # rad, down the gradient
RANDOM_SHARE = 0.5  # sigma of the random direction added to the gradient in half of the trials
CONVERGED = 5e-4  # relative gain of a round that ends the search
WEIGHT_POWER = 4  # power of a reference pose's variance in its weight
WEIGHT_UPDATES = 7
ROUNDS = 15  # of moves per weight update at most


@dataclass(frozen=True)
class RefinedPoses:
    """Readings at refined poses, and their equations."""

    readings: Readings
    rows: Array  # (N, k, P)


@dataclass(frozen=True)
class Refiner:
    """Moves poses to lower the criterion ``trace(weight covariance)``."""

    parameters: Parameters
    observable: Observable
    workspace: Workspace
    candidates: Candidates
    weight: Array  # (P, P)
    sigma: float

    def refined(
        self,
        now: RefinedPoses,
        rounds: int,
        random: np.random.Generator,
        report: Callable[[float], None] | None = None,
    ) -> RefinedPoses:
        """Return the poses after some rounds of moves."""
        before = self.value(now.rows)
        for update in range(rounds):
            now = self._round(now, random)
            after = self.value(now.rows)
            if report:
                report((update + 1) / rounds)
            if after > (1 - CONVERGED) * before:
                break
            before = after
        return now

    def value(self, rows: Array) -> float:
        """Return the expected rms error of the TCP (m) for equations (N, k, P)."""
        return float(np.sqrt(np.sum(self.weight * inverse(information_of(rows)))))

    def _rows(self, readings: Readings) -> Array:
        layout = self.observable.layout(self.candidates.readings)
        given = readings, self.candidates.nuisance, self.sigma, layout
        return whitened_rows(self.parameters, self.observable, *given)

    def _round(self, now: RefinedPoses, random: np.random.Generator) -> RefinedPoses:
        """Return the poses after one round: the best of several trial steps for each."""
        count, n = now.readings.q.shape
        downhill = -self._gradient(now)
        downhill /= np.maximum(np.linalg.norm(downhill, axis=1, keepdims=True), 1e-300)
        random_steps = downhill[:, None] + RANDOM_SHARE * random.normal(
            size=(count, len(LENGTHS), n)
        )
        directions = np.concatenate(
            [np.repeat(downhill[:, None], len(LENGTHS), axis=1), random_steps], axis=1
        )
        q = now.readings.q[:, None] + np.tile(LENGTHS, 2)[None, :, None] * directions
        source = np.repeat(np.arange(count), 2 * len(LENGTHS))
        trials, feasible = self._feasible(now.readings, source, q.reshape(-1, n))
        source = source[feasible]
        rows = np.concatenate([now.rows, self._rows(trials)])
        choice = Choice.of(rows, self.weight, lambda chosen: np.zeros(len(rows)))
        best = list(range(count))
        for place in random.permutation(count):
            rest = [row for i, row in enumerate(best) if i != place]
            score = choice.gains(rest)
            options = np.concatenate([[place], count + np.flatnonzero(source == place)])
            best[place] = int(options[np.argmin(score[options])])
        q = np.concatenate([now.readings.q, trials.q])[best]
        value = np.concatenate([now.readings.value, trials.value])[best]
        return RefinedPoses(replace(now.readings, q=q, value=value), rows[best])

    def _gradient(self, now: RefinedPoses) -> Array:
        """Return d(criterion) / d(joints) (N, n), by central differences of each pose."""
        count, n = now.readings.q.shape
        source = np.repeat(np.arange(count), 2 * n)
        steps = STEP * np.concatenate([np.eye(n), -np.eye(n)])
        stepped = replace(
            now.readings[source], q=now.readings.q[source] + np.tile(steps, (count, 1))
        )
        S = inverse(information_of(now.rows))
        sensitivity = now.rows @ (S @ self.weight @ S)
        decrease = np.einsum(
            "nkp,nkp->n", self._rows(stepped) - now.rows[source], sensitivity[source]
        )
        one, other = -decrease.reshape(count, 2, n).transpose(1, 0, 2)
        return np.asarray((one - other) / STEP)

    def _feasible(self, readings: Readings, source: Index, q: Array) -> tuple[Readings, Index]:
        """Return the measurable readings at joints ``q``, and their rows in ``source``."""
        nominal, nuisance = self.parameters.nominal, self.candidates.nuisance
        moved = replace(readings[source], q=q)
        solved_q = self.observable.solve_joints(nominal, q, moved, nuisance)
        valid = np.flatnonzero(np.isfinite(solved_q).all(axis=1))
        valid = valid[
            measurable(self.observable, self.workspace, replace(moved, q=solved_q)[valid])
        ]
        part = replace(moved, q=solved_q)[valid]
        return replace(part, value=self.observable.predict(nominal, part, nuisance)), valid


def reference_weights(reference: Reference, rows: Array, before: Array | None = None) -> Array:
    """Return updated weights (M,), of mean 1, of the reference poses for the chosen ``rows``.

    ``before`` are the weights with which ``rows`` were chosen; None: equal ones.
    """
    share = reference.std(inverse(information_of(rows))) ** (2 * WEIGHT_POWER)
    share = share if before is None else share * before
    return np.asarray(share / share.mean())


def minimax_refined(
    refiner: Refiner, reference: Reference, start: RefinedPoses, share: Array, seed: int,
    report: Callable[[float], None],
) -> tuple[RefinedPoses, Array]:  # fmt: skip
    """Return the refined poses, and the weight (P, P) of the last update.

    ``share`` (M,) are the initial weights of the reference poses; ``report`` gets the share done.
    """
    now, size = start, start.rows.shape[2]
    for update in range(WEIGHT_UPDATES):

        def partial(part: float, update: int = update) -> None:
            report((update + part) / WEIGHT_UPDATES)

        if update:
            share = reference_weights(reference, now.rows, share)
        refiner = replace(refiner, weight=reference.weight(size, share))
        now = refiner.refined(now, ROUNDS, np.random.default_rng(seed), partial)
        partial(1.0)
    return now, refiner.weight
