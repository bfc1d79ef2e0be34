"""Chosen poses moved so that the TCP is known alike everywhere, the worst places before the others.

The mean variance over the workspace would buy what is known well already with its worst places, and
it is the largest error that an integrator has to answer for. The largest one has no gradient worth
following; so the mean is taken with weights, and a place that stays badly known weighs more after
every bout, as in the multiplicative algorithms of optimal design (Silvey, Titterington, Torsney,
Comm. Stat. A7 (1978); Atkinson, Donev, Tobias, Optimum Experimental Designs (2007), ch. 9).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.planning.information import Reference, information_of, inverse
from gapbridge.core.planning.refinement import Refined, Refiner

LEANING = 4  # power of a place's variance in its weight
BOUTS = 7  # of moves, each with weights of its own
ROUNDS = 15  # of moves in a bout at most


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
