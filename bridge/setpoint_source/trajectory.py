"""Setpoints from a file: CSV with columns timestamp, target_q_0, target_q_1, ..."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.setpoint_source.source import Source, SourceContext
from gapbridge.core.arrays import Array
from gapbridge.core.errors import LogError
from gapbridge.core.log.log import read_log


class TrajectorySource(Source):
    """A recorded or planned motion, replayed at the controller's clock.

    Between two rows joints are interpolated linearly; after the last row the arm holds it. Raises
    LogError if the file is not a trajectory of n joints.
    """

    def __init__(self, context: SourceContext) -> None:
        super().__init__(context)
        path = context.folder / (self.settings.file or "")
        log = read_log(path, self.n)
        self._q: Array = np.ascontiguousarray(log.require("target_q"))
        time = log.require("timestamp")
        backwards = np.flatnonzero(np.diff(time) <= 0.0)
        if len(backwards):
            row = int(backwards[0]) + log.first_row + 1
            raise LogError(
                f"{path}: row {row}, column timestamp: found {time[backwards[0] + 1]:g} after "
                f"{time[backwards[0]]:g}, expected rows in time order"
            )
        self._time = time - time[0]
        self._begun: float | None = None
        self._row = 0
        self._ended = False

    def first(self, robot_q: Array) -> Array | None:
        """Return the first row."""
        first: Array = self._q[0]
        return first

    def begin(self, timestamp: float, robot_q: Array) -> None:
        """Start the clock: the first row is due at ``timestamp``."""
        self._begun, self._row, self._ended = timestamp, 0, False

    def sample(self, timestamp: float, robot_q: Array) -> Array:
        """Return the joints at this moment."""
        time, q, row = self._time, self._q, self._row
        elapsed = timestamp - (timestamp if self._begun is None else self._begun)
        if elapsed >= time[-1]:
            self._ended = True
            last: Array = q[-1]
            return last
        while time[row + 1] <= elapsed:
            row += 1
        self._row = row
        share = (elapsed - time[row]) / (time[row + 1] - time[row])
        joints: Array = q[row] + share * (q[row + 1] - q[row])
        return joints

    @property
    def ended(self) -> bool:
        """Return whether the last row has been reached."""
        return self._ended
