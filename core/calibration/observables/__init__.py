"""Kinds of readings of the TCP: one base class, one file a kind, one table."""

from __future__ import annotations

import difflib
from typing import Any

from gapbridge.core.calibration.observables.distance import Distance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.pose import Pose
from gapbridge.core.calibration.observables.position import Position
from gapbridge.core.calibration.observables.relative import Relative
from gapbridge.core.calibration.observables.touching import Point, Sphere
from gapbridge.core.errors import InputError

OBSERVABLES: dict[str, type[Observable]] = {
    observable.kind: observable
    for observable in (Position, Pose, Distance, Sphere, Point, Relative)
}


def make_observable(kind: str, *, registered: bool = False, **options: Any) -> Observable:
    """Return the observable of a kind; options are its own fields (``radius``, ``zeroed``).

    Raises InputError naming the nearest known kind.
    """
    if kind not in OBSERVABLES:
        near = difflib.get_close_matches(kind, OBSERVABLES, n=1, cutoff=0.4)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise InputError(
            f"kind of reading: found {kind!r}, expected one of {', '.join(OBSERVABLES)}{hint}"
        )
    return OBSERVABLES[kind](registered=registered, **options)  # type: ignore[call-arg]
