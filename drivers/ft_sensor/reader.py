"""A sensor read by a thread of its own, so that nobody waits for it."""

from __future__ import annotations

import math
import threading
import time
from collections import deque

from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError
from gapbridge.drivers.ft_sensor.sensor import ForceTorqueSensor, Reading
from gapbridge.drivers.ft_sensor.settings import FtSensorSettings

KEPT = 64  # samples: enough to look up what was sampled when an arm's state was
LISTEN = 0.1  # s that one read may take
BACKOFF = (0.1, 1.0)  # s before the link is opened anew: first, most


class SensorReader:
    """Keeps the last samples of a sensor. A link that breaks is opened anew, again and again."""

    def __init__(self, sensor: ForceTorqueSensor, settings: FtSensorSettings) -> None:
        self._sensor, self._settings = sensor, settings
        self._readings: deque[Reading] = deque(maxlen=KEPT)
        self._broken = ""  # why the link is down
        self._stopping = threading.Event()
        self._came = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Connect and wait for the first sample. Raises LinkError."""
        self._stopping.clear()
        self._readings.clear()
        self._sensor.connect()
        self._thread = threading.Thread(target=self._run, name="ft-sensor", daemon=True)
        self._thread.start()
        if not self.wait(self._settings.connect_timeout):
            self.stop()
            raise LinkError(
                f"{self._sensor.name}: found no sample within {self._settings.connect_timeout:g} s"
                f"{self._why()}, expected a stream of them (ft_sensor.connect_timeout)"
            )

    def wait(self, timeout: float) -> bool:
        """Wait for the next sample up to ``timeout`` s; returns whether one has come."""
        self._came.clear()
        return self._came.wait(timeout)

    def _why(self) -> str:
        """Return why there may be no sample, for messages."""
        dropped = self._sensor.dropped
        if self._broken:
            return f" ({self._broken})"
        return f" ({dropped} pieces of garbage dropped)" if dropped else ""

    def _run(self) -> None:
        pause = BACKOFF[0]
        while not self._stopping.is_set():
            try:
                if self._broken:
                    self._sensor.connect()
                    self._broken = ""
                reading = self._sensor.read(LISTEN)
            except LinkError as error:
                self._sensor.close()
                self._broken = str(error)
                self._stopping.wait(pause)
                pause = min(2.0 * pause, BACKOFF[1])
                continue
            if reading is not None:
                pause = BACKOFF[0]
                self._readings.append(reading)
                self._came.set()

    def at(self, moment: float) -> Reading:
        """Return what the sensor read at a ``moment`` (s, monotonic), between two samples if need.

        Never waits, and never looks ahead: for a moment after the last sample, that sample holds.
        Raises StaleStateError where that is older than ``max_age``, InvalidStateError where the
        sensor is overloaded or says that it is not well.
        """
        readings = list(self._readings)
        self._require_fresh(readings)
        later = readings[-1]
        self._require_sound(later)
        for earlier in reversed(readings[:-1]):
            if later.timestamp <= moment:
                break
            if earlier.timestamp <= moment:
                self._require_sound(earlier)
                return _between(earlier, later, moment)
            later = earlier
        self._require_sound(later)
        return later

    def _require_fresh(self, readings: list[Reading]) -> None:
        limit = self._settings.max_age
        age = time.monotonic() - readings[-1].timestamp if readings else float("inf")
        if age > limit:
            raise StaleStateError(
                f"{self._sensor.name}: found the last sample {age:.3f} s old{self._why()}, "
                f"expected at most {limit:g} s (ft_sensor.max_age)"
            )

    def _require_sound(self, reading: Reading) -> None:
        name, limits = self._sensor.name, self._settings.overload
        if reading.status:
            raise InvalidStateError(f"{name}: {self._sensor.describe(reading.status)}")
        for what, unit, limit, part in (
            ("force", "N", limits.force, reading.wrench[:3]),
            ("torque", "Nm", limits.torque, reading.wrench[3:]),
        ):
            if limit is None:
                continue
            size = math.hypot(*part)
            if not size <= limit:
                raise InvalidStateError(
                    f"{name}: overload: found a {what} of {size:.1f} {unit}, expected at most "
                    f"{limit:g} (ft_sensor.overload.{what})"
                )

    def stop(self) -> None:
        """End the thread and close the sensor; may be repeated."""
        self._stopping.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(5.0)
        self._sensor.close()


def _between(earlier: Reading, later: Reading, moment: float) -> Reading:
    """Return the sample at a moment between two."""
    share = (moment - earlier.timestamp) / max(later.timestamp - earlier.timestamp, 1e-9)
    wrench = earlier.wrench + min(share, 1.0) * (later.wrench - earlier.wrench)
    return Reading(moment, later.received, wrench)
