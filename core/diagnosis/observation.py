"""One channel of a log: measured values, their prediction, and quantities they may depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.effects import Term

HELD_TORQUE = "held_torque"  # Nm, static torque of a joint: a quantity that is no column of the log
UnnamedColumns = tuple[tuple[str, Array], ...]
Predict = Callable[[Sequence[Term]], Array]


@dataclass(frozen=True)
class NotObservable:
    """A channel that is not observable in the log, and the columns it needs."""

    channel: str
    needs: tuple[str, ...]


@dataclass(frozen=True)
class Observation:
    """One channel of one log, ready to be diagnosed. N samples of k coordinates each.

    ``predict(terms)`` gives the channel's values with these terms added to the cell's own model;
    the gap is ``measured - predict(())``. ``nuisance`` columns (frames) are estimated together with
    all effects.
    """

    channel: str
    unit: str
    measured: Array  # (N, k)
    predict: Predict
    nuisance: Array  # (N, k, p) d measured / d nuisance
    weight: Array  # (k,) 1/unit: makes the coordinates comparable (1 for the channel's own unit)
    sigma: float  # known 1 sigma of one coordinate; 0: unknown
    sigma_is_whole: bool  # True: sigma is the total noise
    quantities: Mapping[str, Array]  # column name -> (N,), on which a residual may depend
    groups: NDArray[np.int64]  # (N,) condition of each sample, held out together
    rows: NDArray[np.int64]  # (N,) row of each sample in the log
    axes: tuple[str, ...]  # name of each coordinate
    joint_columns: Array | None = None  # (N, k, n) d prediction / d joint angle
    unnamed: Callable[[], UnnamedColumns] = tuple  # target, columns (N, k, d) of unnamed causes
    friction: Array | None = None  # (N, k) sign of each joint's motion, in torque
    tool_axes: Array | None = None  # (N, 3, 3) axes of the TCP in base, as columns
    axial_moment: Array | None = None  # (N, n) Nm about each joint's axis
    times: Array | None = None  # (N,) s or row numbers, for steps
    payload_mass: Array | None = None  # (N,) kg, declared in the log; None: the cell's
    order_in_time: bool = False  # True: a recording of motion, correlated in time
    # nuisance step (p,), terms -> the observation with moved frames and columns at these terms
    rebase: Callable[[Array, Sequence[Term]], Observation] | None = None
    # 1 sigma (k,) from neighbouring samples of a recording
    instrument: Callable[[], Array | None] | None = None
    subset: Callable[[NDArray[np.int64]], Observation] | None = (
        None  # indices -> the observation of these samples
    )
    # terms -> (N, k, r) 1-sigma changes of the prediction by the cell's fitted parameters
    uncertain: Callable[[Sequence[Term]], Array] | None = None
    session: NDArray[np.int64] | None = None  # (N,) session of each sample; None: there is one
    free_frame: bool = False  # True: the first six nuisance columns are an instrument's frame
    nuisance_session: tuple[int, ...] = ()  # (p,) session of each nuisance column, where several

    def rebased(self, step: Array, terms: Sequence[Term]) -> Observation:
        """Return the observation after a nuisance step (p,), with columns at these terms."""
        assert self.rebase is not None
        return replace(
            self.rebase(step, terms), uncertain=self.uncertain, groups=self.groups,
            order_in_time=self.order_in_time, instrument=self.instrument,
        )  # fmt: skip

    def axial_columns(self) -> Array:
        """Return d prediction / d axial compliance (N, k, n), to first order."""
        assert self.joint_columns is not None and self.axial_moment is not None
        return self.joint_columns * self.axial_moment[:, None, :]


def stacked(
    parts: Sequence[Observation], quantities: Mapping[str, Array], groups: NDArray[np.int64]
) -> Observation:
    """Return the observations of several sessions as one, with a nuisance for each.

    ``quantities`` and ``groups`` (N,) are those of all samples: a pose that several sessions
    repeat is one condition. ``rows`` of the parts are rows of the joined log.
    """
    size = [len(part.rows) for part in parts]
    width = [part.nuisance.shape[2] for part in parts]
    session = [0 if part.session is None else int(part.session[0]) for part in parts]
    columns = np.cumsum([0, *width])

    def together(name: str) -> Array | None:
        columns = [getattr(part, name) for part in parts]
        return None if any(f is None for f in columns) else np.concatenate(columns)

    def predict(terms: Sequence[Term]) -> Array:
        return np.concatenate([part.predict(terms) for part in parts])

    def unnamed() -> UnnamedColumns:
        each = [dict(part.unnamed()) for part in parts]
        return tuple(
            (target, np.concatenate([rivals[target] for rivals in each]))
            for target in each[0]
            if all(target in rivals for rivals in each)
        )

    def rebase(step: Array, terms: Sequence[Term]) -> Observation:
        moved = [
            part if part.rebase is None else part.rebase(step[columns[i] : columns[i + 1]], terms)
            for i, part in enumerate(parts)
        ]
        changed = {n: z for n, z in quantities.items() if not n.startswith("measured_position")}
        for k in range(3):
            name = f"measured_position_{k}"
            if name in quantities:
                changed[name] = np.concatenate([m.measured[:, k] for m in moved])
        return stacked(moved, changed, groups)

    return replace(
        parts[0],
        measured=np.concatenate([part.measured for part in parts]),
        predict=predict,
        nuisance=_block_diagonal([part.nuisance for part in parts]),
        quantities=quantities,
        groups=groups,
        rows=np.concatenate([part.rows for part in parts]),
        joint_columns=together("joint_columns"),
        unnamed=unnamed,
        tool_axes=together("tool_axes"),
        axial_moment=together("axial_moment"),
        times=together("times"),
        payload_mass=together("payload_mass"),
        rebase=rebase if columns[-1] else None,
        session=np.repeat(session, size),
        nuisance_session=tuple(int(s) for s in np.repeat(session, width)),
    )


def _block_diagonal(parts: Sequence[Array]) -> Array:
    """Return columns (N, k, p) of several parts as those of all samples, zero beyond each part."""
    rows = np.cumsum([0, *(len(part) for part in parts)])
    columns = np.cumsum([0, *(part.shape[2] for part in parts)])
    whole = np.zeros((int(rows[-1]), parts[0].shape[1], int(columns[-1])))
    for i, part in enumerate(parts):
        whole[rows[i] : rows[i + 1], :, columns[i] : columns[i + 1]] = part
    return whole
