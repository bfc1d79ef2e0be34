"""Readings predicted by a model: for plans, checks and simulated sessions."""

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

DEFAULT_RADIUS = 0.03  # m, usual radius of sphere and ball together


def unmeasured_readings(
    kind: str, q: Array, loads: Loads, **columns: NDArray[np.int64]
) -> Readings:
    """Return readings without values at joints ``q`` (N, n), rad.

    ``columns`` may hold ``load``, ``station``, ``target`` (default: zeros) and ``pose`` (default:
    the row's number), (N,) each.
    """
    count = len(q)
    zeros = np.zeros(count, dtype=np.int64)
    usual = {"load": zeros, "station": zeros, "target": zeros, "pose": np.arange(count)}
    return Readings(
        kind, q, np.zeros((count, 0)), np.full(count, np.nan), loads,
        held_out=np.zeros(count, dtype=bool), **{**usual, **columns},
    )  # fmt: skip


def predicted_readings(
    observable: Observable, model: Model, readings: Readings, nuisance: Nuisance
) -> Readings:
    """Return the readings with the values that ``model`` predicts, without noise.

    For kinds without an instrument the joints are solved for contact; rows without a solution are
    left out.
    """
    q = observable.solve_joints(model, readings.q, readings, nuisance)
    reachable = np.flatnonzero(np.isfinite(q).all(axis=1))
    readings = replace(readings, q=q, value=np.zeros((len(q), observable.width)))[reachable]
    return replace(readings, value=observable.predict(model, readings, nuisance))


def concatenated(one: Readings, other: Readings) -> Readings:
    """Return the readings of both, one after the other, with the load columns that both have."""
    loads = Loads(**{f.name: _joined(one.loads, other.loads, f.name) for f in fields(Loads)})
    columns = {f.name: _joined(one, other, f.name) for f in fields(Readings)[1:]}
    return Readings(one.kind, **(columns | {"loads": loads}))


def _joined(one: Any, other: Any, name: str) -> Any:
    first, second = getattr(one, name), getattr(other, name)
    if first is None or second is None or isinstance(first, Loads):
        return None
    return np.concatenate([first, second])


def typical_nuisance(
    model: Model, observable: Observable, readings: Readings, seed: int = 0
) -> Nuisance:
    """Return a random nuisance of usual size: instruments, fixed points and balls within reach."""
    random = np.random.default_rng(seed)
    layout = observable.layout(readings)
    nuisance = Nuisance.zero(layout.stations, layout.targets)
    targets = nuisance.targets.copy()
    targets[1:] = random.normal(0, 0.1, (layout.targets - 1, 3))
    if observable.kind == "relative":
        targets[1:] += [0.2, 0, 0]
    lengths = np.full(layout.stations, getattr(observable, "radius", None) or DEFAULT_RADIUS)
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
