"""Structure of what is left of all rows: size and outliers of poses, whiteness of a recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MAX_OUTLIER_SHARE, OVER_REPEAT_SCATTER
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.noise_floor import Floor, noise_floor, whiteness
from gapbridge.core.diagnosis.selection.outliers import whitened
from gapbridge.core.diagnosis.selection.selection import Selection

Depends = tuple[tuple[str, float], ...]  # quantity, share


def with_excess(
    judgement: Judgement, selection: Selection, remaining: Array,
    depends: Callable[[Sequence[int]], Depends],
) -> Judgement:  # fmt: skip
    """Return the judgement with structure if poses leave more than the noise of those searched.

    ``remaining`` (N, k) is the residual of all of them. A cause of the searched ones that all rows
    withdraw leaves such a residual, and so does what these do not show. So do many outliers.
    """
    if selection.observation.order_in_time or judgement.structured:
        return judgement
    white = whitened(selection.noise, remaining)[selection.kept]
    variance = float(np.mean(white**2))
    if np.mean(~selection.kept) > MAX_OUTLIER_SHARE:
        p_value = 0.0
    elif variance > OVER_REPEAT_SCATTER**2:
        from scipy.special import gammaincc  # slow to import

        p_value = float(gammaincc(white.size / 2, white.size * variance / 2))
    else:
        return judgement
    return _structured(judgement, p_value, depends)


def with_whiteness(
    judgement: Judgement, selection: Selection, means: Array | None,
    depends: Callable[[Sequence[int]], Depends],
) -> tuple[Judgement, Floor]:  # fmt: skip
    """Return the judgement with the whiteness test of a recording's residual, and the floor."""
    floor = noise_floor(selection, judgement.structured)
    test = whiteness(means, floor.rms)
    if test is None or test.white:
        return judgement, floor
    return _structured(judgement, test.p_value, depends), noise_floor(selection, True)


def _structured(
    judgement: Judgement, p_value: float, depends: Callable[[Sequence[int]], Depends]
) -> Judgement:
    if judgement.p_value is not None:
        p_value = min(p_value, judgement.p_value)
    return replace(
        judgement,
        structured=True,
        p_value=p_value,
        depends_on=judgement.depends_on or depends(judgement.accused),
    )
