"""Chosen poses moved a little, joint by joint, to where they are more informative.

The candidates of a plan are a coarse sample of six or more joints; between them lie better poses.
Each pose goes down the gradient of the criterion, as far as limits, obstacles and sight allow.

So that the TCP is known alike everywhere, the worst places go before the others. The mean variance
over the workspace would buy what is known well already with its worst places, and it is the largest
error that an integrator has to answer for. The largest one has no gradient worth following; so the
mean is taken with weights, and a place that stays badly known weighs more after every bout, as in
the multiplicative algorithms of optimal design (Silvey, Titterington, Torsney, Comm. Stat. A7
(1978); Atkinson, Donev, Tobias, Optimum Experimental Designs (2007), ch. 9).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array, Index
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.planning.candidates import Candidates, readable
from gapbridge.core.planning.exchange import Choice
from gapbridge.core.planning.information import Reference, blocks, information_of, inverse
from gapbridge.core.planning.workspace import Workspace

NUDGE = 0.02  # rad, for the gradient
LENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5)  # rad, down the gradient
ASIDE = 0.5  # how far beside the gradient as many more steps go
CONVERGED = 5e-4  # relative gain of a round that ends the search
LEANING = 4  # power of a place's variance in its weight
BOUTS = 7  # of moves, each with weights of its own
ROUNDS = 15  # of moves in a bout at most


@dataclass(frozen=True)
class Refined:
    """Readings at poses that were moved, and their equations."""

    readings: Readings
    rows: Array  # (N, k, P)


@dataclass(frozen=True)
class Refiner:
    """What moving a pose needs to know."""

    parameters: Parameters
    observable: Observable
    workspace: Workspace
    found: Candidates
    weight: Array  # (P, P)
    sigma: float

    def refined(
        self,
        now: Refined,
        rounds: int,
        random: np.random.Generator,
        report: Callable[[float], None] | None = None,
    ) -> Refined:
        """Return the poses after some rounds of moves."""
        before = self.value(now.rows)
        for number in range(rounds):
            now = self._round(now, random)
            after = self.value(now.rows)
            if report:
                report((number + 1) / rounds)
            if after > (1 - CONVERGED) * before:
                break
            before = after
        return now

    def value(self, rows: Array) -> float:
        """Return the expected rms error of the TCP (m) that equations (N, k, P) leave."""
        return float(np.sqrt(np.sum(self.weight * inverse(information_of(rows)))))

    def _rows(self, readings: Readings) -> Array:
        layout = self.observable.layout(self.found.readings)
        given = readings, self.found.nuisance, self.sigma, layout
        return blocks(self.parameters, self.observable, *given)

    def _round(self, now: Refined, random: np.random.Generator) -> Refined:
        """Return the poses after each was offered some steps, the best taken."""
        count, n = now.readings.q.shape
        downhill = -self._gradient(now)
        downhill /= np.maximum(np.linalg.norm(downhill, axis=1, keepdims=True), 1e-300)
        beside = downhill[:, None] + ASIDE * random.normal(size=(count, len(LENGTHS), n))
        ways = np.concatenate([np.repeat(downhill[:, None], len(LENGTHS), axis=1), beside], axis=1)
        q = now.readings.q[:, None] + np.tile(LENGTHS, 2)[None, :, None] * ways
        own = np.repeat(np.arange(count), 2 * len(LENGTHS))
        offered, good = self._moved(now.readings, own, q.reshape(-1, n))
        own = own[good]
        rows = np.concatenate([now.rows, self._rows(offered)])
        choice = Choice.of(rows, self.weight, lambda chosen: np.zeros(len(rows)))
        best = list(range(count))
        for place in random.permutation(count):
            rest = [row for i, row in enumerate(best) if i != place]
            score = choice.gains(rest)
            mine = np.concatenate([[place], count + np.flatnonzero(own == place)])
            best[place] = int(mine[np.argmin(score[mine])])
        q = np.concatenate([now.readings.q, offered.q])[best]
        value = np.concatenate([now.readings.value, offered.value])[best]
        return Refined(replace(now.readings, q=q, value=value), rows[best])

    def _gradient(self, now: Refined) -> Array:
        """Return d(criterion) / d(joints) (N, n), to first order in each pose alone."""
        count, n = now.readings.q.shape
        own = np.repeat(np.arange(count), 2 * n)
        nudges = NUDGE * np.concatenate([np.eye(n), -np.eye(n)])
        near = replace(now.readings[own], q=now.readings.q[own] + np.tile(nudges, (count, 1)))
        S = inverse(information_of(now.rows))
        pull = now.rows @ (S @ self.weight @ S)
        fall = np.einsum("nkp,nkp->n", self._rows(near) - now.rows[own], pull[own])
        one, other = -fall.reshape(count, 2, n).transpose(1, 0, 2)
        return np.asarray((one - other) / NUDGE)

    def _moved(self, readings: Readings, own: Index, q: Array) -> tuple[Readings, Index]:
        """Return readings at moved joints that can be taken, and which of ``own`` they are."""
        nominal, nuisance = self.parameters.nominal, self.found.nuisance
        whole = replace(readings[own], q=q)
        at = self.observable.brought(nominal, q, whole, nuisance)
        there = np.flatnonzero(np.isfinite(at).all(axis=1))
        there = there[readable(self.observable, self.workspace, replace(whole, q=at)[there])]
        part = replace(whole, q=at)[there]
        return replace(part, value=self.observable.predict(nominal, part, nuisance)), there


def leaning(reference: Reference, rows: Array, before: Array | None = None) -> Array:
    """Return the weights (M,), of mean 1, of the reference's places after a choice of ``rows``.

    ``before`` are those with which that choice was made; none: all alike.
    """
    share = reference.std(inverse(information_of(rows))) ** (2 * LEANING)
    share = share if before is None else share * before
    return np.asarray(share / share.mean())


def evened(
    refiner: Refiner, reference: Reference, begin: Refined, share: Array, seed: int,
    reported: Callable[[float], None],
) -> tuple[Refined, Array]:  # fmt: skip
    """Return the poses after some bouts of moves, and the weight (P, P) of the last one.

    ``share`` (M,) are the places' weights in the first; ``report`` gets the share that is done.
    """
    now, size = begin, begin.rows.shape[2]
    for number in range(BOUTS):

        def along(part: float, begun: int = number) -> None:
            reported((begun + part) / BOUTS)

        if number:
            share = leaning(reference, now.rows, share)
        refiner = replace(refiner, weight=reference.weight(size, share))
        now = refiner.refined(now, ROUNDS, np.random.default_rng(seed), along)
        along(1.0)
    return now, refiner.weight
