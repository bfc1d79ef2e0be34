"""What one channel shows: measured values, how to predict them, and what they may depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.effects import Term

Array = NDArray[np.float64]
Rivals = tuple[tuple[str, Array], ...]
Predict = Callable[[Sequence[Term]], Array]


@dataclass(frozen=True)
class NotObservable:
    """A channel that the log does not show, and the columns it would need."""

    channel: str
    needs: tuple[str, ...]


@dataclass(frozen=True)
class Observation:
    """One channel of one log, ready to be diagnosed. N samples of k coordinates each.

    ``predict(terms)`` gives the channel's values with these terms added to the cell's own model;
    the gap is ``measured - predict(())``. ``nuisance`` columns (frames, biases that are nobody's
    fault) are estimated along with everything else.
    """

    channel: str
    unit: str
    measured: Array  # (N, k)
    predict: Predict
    nuisance: Array  # (N, k, p) d measured / d nuisance
    weight: Array  # (k,) 1/unit: makes the coordinates comparable (1 for the channel's own unit)
    sigma: float  # 1 sigma of one coordinate that is known beforehand; 0: nothing is
    sigma_is_whole: bool  # True: nothing comes on top of sigma
    quantities: Mapping[str, Array]  # column name -> (N,): what a leftover may depend on
    groups: NDArray[np.int64]  # (N,) condition of each sample: held out as a whole
    rows: NDArray[np.int64]  # (N,) row of each sample in the log
    axes: tuple[str, ...]  # name of each coordinate
    joint_columns: Array | None = None  # (N, k, n) d prediction / d joint angle, where it has one
    unnamed: Callable[[], Rivals] = tuple  # target, columns (N, k, d) of further rivals
    friction: Array | None = None  # (N, k) sign of each joint's motion, where friction shows
    tool_axes: Array | None = None  # (N, 3, 3) axes of the TCP in base, as columns
    axial_moment: Array | None = None  # (N, n) Nm about each joint's axis, where it is known
    order_in_time: bool = False  # True: neighbours in time are correlated (a moving log)
    rebase: Callable[[Array], Observation] | None = None  # the same with the nuisance moved (p,)

    def axial_columns(self) -> Array:
        """Return d prediction / d axial compliance (N, k, n), to first order."""
        assert self.joint_columns is not None and self.axial_moment is not None
        return self.joint_columns * self.axial_moment[:, None, :]


def thinned(observation: Observation, most: int) -> Observation:
    """Return the observation with at most so many samples, evenly taken; predictions stay whole.

    Delays and derivatives are then still those of the full log.
    """
    count = len(observation.rows)
    if count <= most:
        return observation
    take = np.unique(np.linspace(0, count - 1, most).astype(int))
    whole, unnamed = observation.predict, observation.unnamed

    def some(columns: Array | None) -> Array | None:
        return None if columns is None else columns[take]

    return replace(
        observation,
        measured=observation.measured[take],
        predict=lambda terms: whole(terms)[take],
        nuisance=observation.nuisance[take],
        quantities={name: z[take] for name, z in observation.quantities.items()},
        groups=observation.groups[take],
        rows=observation.rows[take],
        joint_columns=some(observation.joint_columns),
        unnamed=lambda: tuple((target, columns[take]) for target, columns in unnamed()),
        friction=some(observation.friction),
        tool_axes=some(observation.tool_axes),
        axial_moment=some(observation.axial_moment),
        rebase=None,
    )
