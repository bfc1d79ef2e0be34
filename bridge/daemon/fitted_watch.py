"""Warning of extrapolation: joints, loads or temperatures outside the range of the fit.

Outside its range the model is extrapolated; compensation goes on, with one warning while it lasts.
"""

from __future__ import annotations

from collections.abc import Mapping

from gapbridge.core.arrays import Array
from gapbridge.core.fitted_range import UNITS, Range, beyond, stem_of
from gapbridge.core.log.columns import label

WATCHED = ("actual_q", "payload", "joint_temperatures", "actual_TCP_force")
QUIET = 5.0  # s within the fitted range after which leaving it is reported again


class FittedWatch:
    """Compares the cycles of a run with the range of the data that the model was fitted on.

    ``slices``: where each field is in a cycle's row (SharedMemory.slices).
    """

    def __init__(self, fitted: Range, slices: Mapping[str, slice]) -> None:
        self._places: list[tuple[str, int]] = []
        for field in WATCHED:
            part = slices[field]
            for i, place in enumerate(range(part.start, part.stop)):
                name = field if part.stop - part.start == 1 else f"{field}_{i}"
                if name in fitted:
                    self._places.append((name, place))
        self._fitted = fitted
        self._outside: dict[str, float] = {}  # column -> s, monotonic: when it was last outside

    def take(self, rows: Array, now: float) -> list[str]:
        """Return a message for each quantity that has just left the fitted range.

        ``rows`` (k, width): cycles of the loop; ``now``: s, monotonic.
        """
        reported = []
        for name, place in self._places:
            values = rows[:, place]
            out = beyond(name, values, self._fitted)
            if not out.any():
                if name in self._outside and now - self._outside[name] > QUIET:
                    del self._outside[name]
                continue
            if name not in self._outside:
                low, high = self._fitted[name]
                reported.append(
                    f"{label(name)}: found {values[out][0]:.4g} {UNITS[stem_of(name)]}, outside "
                    f"what was fitted, {low:.4g} to {high:.4g}: the correction is an extrapolation"
                )
            self._outside[name] = now
        return reported
