"""Readings as a model predicts them: for plans, checks and simulated sessions."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.fixed_point import fixed_at
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

TOUCHED = 0.03  # m, usual radius of sphere and ball together


def empty_readings(kind: str, q: Array, loads: Loads, **given: NDArray[np.int64]) -> Readings:
    """Return readings without values at joints ``q`` (N, n); ``given`` are further columns.

    ``load``, ``station``, ``target``, ``pose`` (N,); left out, they are zeros, and the pose the
    row's number.
    """
    count = len(q)
    zeros = np.zeros(count, dtype=np.int64)
    columns = {"load": zeros, "station": zeros, "target": zeros, "pose": np.arange(count), **given}
    return Readings(
        kind, q, np.zeros((count, 0)), np.full(count, np.nan), loads,
        held_out=np.zeros(count, dtype=bool), **columns,
    )  # fmt: skip


def predicted_readings(
    observable: Observable, model: Model, readings: Readings, nuisance: Nuisance
) -> Readings:
    """Return the readings with the values that ``model`` predicts, exactly.

    Where the arm is brought to something its joints become those that touch it; rows from which it
    cannot be reached are left out.
    """
    q = observable.brought(model, readings.q, readings, nuisance)
    reached = np.flatnonzero(np.isfinite(q).all(axis=1))
    readings = replace(readings, q=q, value=np.zeros((len(q), observable.width)))[reached]
    return replace(readings, value=observable.predict(model, readings, nuisance))


def beside(one: Readings, other: Readings) -> Readings:
    """Return the readings of both, one after the other, with what both know of their loads."""
    loads = Loads(**{f.name: _both(one.loads, other.loads, f.name) for f in fields(Loads)})
    columns = {f.name: _both(one, other, f.name) for f in fields(Readings)[1:]}
    return Readings(one.kind, **(columns | {"loads": loads}))


def _both(one: Any, other: Any, name: str) -> Any:
    first, second = getattr(one, name), getattr(other, name)
    if first is None or second is None or isinstance(first, Loads):
        return None
    return np.concatenate([first, second])


def usual_nuisance(
    model: Model, observable: Observable, readings: Readings, seed: int = 0
) -> Nuisance:
    """Return a nuisance of a usual kind: instruments, fixed points and balls within reach."""
    random = np.random.default_rng(seed)
    layout = observable.layout(readings)
    nuisance = Nuisance.zero(layout.stations, layout.targets)
    targets = nuisance.targets.copy()
    targets[1:] = random.normal(0, 0.1, (layout.targets - 1, 3))
    if observable.kind == "relative":
        targets[1:] += [0.2, 0, 0]
    lengths = np.full(layout.stations, getattr(observable, "radius", None) or TOUCHED)
    if observable.kind == "distance":
        lengths[:] = 0.0
    if not observable.unknown:
        return Nuisance(nuisance.stations, targets, lengths)
    position = model.predict(readings.q, readings.loads).position
    centre, spread = position.mean(axis=0), position.std(axis=0)
    places = [
        fixed_at(centre + 0.7 * spread * random.normal(size=3)) for _ in range(layout.stations)
    ]
    return Nuisance(tuple(places), targets, lengths)
