"""Any arm's driver joined with a force-torque sensor: one driver for the loop.

The sensor is read in a thread, so that the loop never waits for it.
"""

from __future__ import annotations

import math
import threading
from collections import deque

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, acting, correcting
from gapbridge.core.errors import (
    InvalidStateError,
    LinkError,
    StaleStateError,
    WriteError,
    first_line,
)
from gapbridge.core.kernels import reference as kernel
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion
from gapbridge.core.rotation import rpy_matrix, skew
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_facts import ControllerFacts, Difference
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor import make_sensor
from gapbridge.drivers.ft_sensor.sensor import ClockOffset, ForceTorqueSensor, Reading
from gapbridge.drivers.ft_sensor.settings import FtSensorSettings, SensorFrame

KEPT = 64  # samples stored, to interpolate at the time of an arm's state
LISTEN = 0.1  # s that one read may take
BACKOFF = (0.1, 1.0)  # s before the link is reopened: first, most


class DriverWithSensor(Driver):
    """An arm's driver whose states carry the wrench of a sensor on the flange.

    The offset of the arm's clock is estimated from arrivals, the sensor's samples have this
    machine's time, and each state gets the wrench at its sampling time. The arm's cycle never waits
    for the sensor.
    """

    def __init__(self, arm: Driver, settings: FtSensorSettings, model: Model) -> None:
        super().__init__(arm.rate, model, arm.moves_arm, arm.clock)
        self.gate = arm.gate
        self.settings = settings
        self._arm = arm
        self._reader = SensorReader(make_sensor(settings, arm.clock), settings, arm.clock)
        self._clock = ClockOffset()
        self._to_flange = sensor_to_flange(settings.sensor_in_flange)
        self._tcp_force = TcpForce(model) if settings.tcp_force == "sensor" else None

    def connect(self) -> None:
        """Open both links. Raises LinkError."""
        self._clock = ClockOffset()
        self._arm.connect()
        try:
            self._reader.start()
        except LinkError:
            self._arm.close()
            raise

    def _read_state(self) -> RobotState:
        """Return the arm's next sample with the sensor's wrench; see Driver.read_state.

        If the sensor is silent, overloaded or faulty, the state has no force and the reason in
        ``sensor_lost``; with ``when_lost: stop`` raises StaleStateError, InvalidStateError.
        """
        state = self._arm.read_state()
        moment = self._clock.take(state.timestamp, state.received)
        try:
            wrench = self._to_flange @ self._reader.at(moment).wrench
        except (StaleStateError, InvalidStateError) as error:
            if self.settings.when_lost == "stop":
                raise
            force = state.actual_TCP_force if self._tcp_force is None else np.full(6, np.nan)
            return state._replace(
                ft_raw_wrench=None, actual_TCP_force=force, sensor_lost=str(error)
            )
        if self._tcp_force is None:
            return state._replace(ft_raw_wrench=wrench)
        force = self._tcp_force.of(wrench, state)
        return state._replace(ft_raw_wrench=wrench, actual_TCP_force=force)

    def reset_check(self) -> None:
        """See Driver.reset_check."""
        super().reset_check()
        self._arm.reset_check()

    def keep_alive(self) -> None:
        """See Driver.keep_alive."""
        self._arm.keep_alive()

    def round_trip(self) -> float | None:
        """See Driver.round_trip."""
        return self._arm.round_trip()

    def take_round_trip(self) -> float | None:
        """See Driver.take_round_trip."""
        return self._arm.take_round_trip()

    def transit_time(self) -> float:
        """See Driver.transit_time."""
        return self._arm.transit_time()

    def unanswered_since(self) -> float:
        """See Driver.unanswered_since."""
        return self._arm.unanswered_since()

    def facts(self, state: RobotState) -> ControllerFacts:
        """See Driver.facts."""
        return self._arm.facts(state)

    def differences(self, state: RobotState) -> list[Difference]:
        """See Driver.differences."""
        return self._arm.differences(state)

    def mismatch(self) -> str | None:
        """See Driver.mismatch."""
        return self._arm.mismatch()

    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint to the arm: not by its write_setpoint, which has the same gate."""
        self._arm._send_for(self, setpoint)

    def _take_lapsed(self) -> bool:
        """See Driver.take_lapsed."""
        return self._arm._take_lapsed()

    def close(self) -> None:
        """Close both links."""
        try:
            self._arm.close()
        finally:
            self._reader.stop()

    def _make_ready(self, state: RobotState) -> None:
        """Arm the arm's driver once the sensor has sent a new sample."""
        if not self._reader.wait(self.settings.connect_timeout):
            raise WriteError(
                f"found no sample of the sensor within {self.settings.connect_timeout:g} s of "
                "arming (ft_sensor.connect_timeout)"
            )
        self._arm._make_ready(state)

    def _release(self) -> None:
        """Stop writing to the arm."""
        self._arm._release()

    def _abandon(self) -> None:
        """Stop writing to the arm in a fault."""
        self._arm._abandon()

    def nominal_q(self, state: RobotState) -> Array:
        """See Driver.nominal_q."""
        return self._arm.nominal_q(state)


def sensor_to_flange(frame: SensorFrame) -> Array:
    """Return the matrix (6, 6) from a wrench in sensor axes to one in flange axes.

    Torques are about the sensor's origin, then about the flange's origin.
    """
    rotation, position = rpy_matrix(np.array(frame.rpy)), np.array(frame.xyz)
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[3:, :3] = skew(position) @ rotation
    return matrix


class TcpForce:
    """Derives ``actual_TCP_force`` from the flange sensor, as controllers do from their own.

    The payload's weight is subtracted, the declared one and what the model's effects add to it (not
    its inertia: the result holds for slow motion), and the sensor errors in the model are
    corrected. Deflection is neglected.
    """

    def __init__(self, model: Model) -> None:
        self._model = model
        self._tool = np.array(model.tool_in_flange, dtype=float)
        self._undo, self._bias = _sensor_correction(model)
        self._gravity = model.chain().gravity  # the true one, turned by the model's effects
        # prepared once: Model.predict would do it in every cycle
        rigid = model.without_terms()
        self._chain, self._rows = rigid.chain(), rigid.rows(np.zeros((1, model.arm.n)))
        undeclared = correcting("payload")
        self._undeclared = [t for t in model.terms if t.effect in undeclared]
        self._no_loads = Loads()
        self._place = np.empty((1, 3)), np.empty((1, 3, 3))
        self._flange_in_base()  # loads compiled code before the first cycle

    def of(self, wrench_in_flange: Array, state: RobotState) -> Array:
        """Return force and torque (6,) of the surroundings on the tool, at the TCP, base axes.

        ``wrench_in_flange`` is the sensor's wrench (6,), flange axes, about the flange origin. The
        declared payload is the controller's, else the model's.
        """
        model, rows = self._model, self._rows
        rows.q[0] = state.actual_q
        rows.payload_mass[0] = model.payload_mass if state.payload is None else state.payload
        rows.payload_cog[0] = model.payload_cog if state.payload_cog is None else state.payload_cog
        model.condition(rows, self._no_loads, rows.q, self._undeclared)
        mass, cog = rows.payload_mass[0], rows.payload_cog[0]
        flange_in_base = self._flange_in_base()
        weight = flange_in_base.T @ (mass * self._gravity)
        wrench = self._undo @ (wrench_in_flange - self._bias)
        force = wrench[:3] - weight
        torque = wrench[3:] - _cross(cog, weight) - _cross(self._tool[:3, 3], force)
        return np.concatenate([flange_in_base @ force, flange_in_base @ torque])

    def _flange_in_base(self) -> Array:
        """Return the rigid arm's flange rotation (3, 3) at the joints in ``_rows``."""
        kernel.predict_rows(self._chain, self._rows, *self._place)
        rotation: Array = self._place[1][0] @ self._tool[:3, :3].T
        return rotation


def _cross(a: Array, b: Array) -> Array:
    """Return a x b of two vectors (3,), ten times as fast as numpy.cross."""
    return np.array(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


def _sensor_correction(model: Model) -> tuple[Array, Array]:
    """Return matrix (6, 6) and bias (6,): wrench = matrix (reading - bias)."""
    probes = np.vstack([np.zeros((1, 6)), np.eye(6)])
    for term in acting(model.terms, "wrench"):
        effect = CATALOGUE[term.effect]
        # errors of the sensor; a drift needs the time of its log
        if effect.channels == ("wrench",) and "timestamp" not in effect.needs:
            at_rest = Motion.at_rest(np.zeros((len(probes), model.arm.n)), Loads())
            probes = effect.sense(term, model.arm, probes, at_rest)
    bias = probes[0]
    return np.linalg.inv((probes[1:] - bias).T), bias


class SensorReader:
    """Stores the last samples of a sensor. A broken link is reopened until it works."""

    def __init__(self, sensor: ForceTorqueSensor, settings: FtSensorSettings, clock: Clock) -> None:
        self._sensor, self._settings = sensor, settings
        self._clock = clock  # the age of samples is measured by it
        self._readings: deque[Reading] = deque(maxlen=KEPT)
        self._broken = ""  # why the link is broken
        self._stopping = threading.Event()
        self._new_sample = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Connect and wait for the first sample. Raises LinkError."""
        self._stopping.clear()
        self._readings.clear()
        try:
            self._sensor.connect()
        except Exception as error:  # as in _run
            self._sensor.close()
            raise LinkError(self._report(error)) from error
        self._new_sample.clear()  # before the thread: its first sample may be the only one for now
        self._thread = self._begin_thread()
        if not self._clock.wait(self._new_sample, self._settings.connect_timeout):
            self.stop()
            raise LinkError(
                f"{self._sensor.name}: found no sample within {self._settings.connect_timeout:g} s"
                f"{self._why()}, expected a stream of them (ft_sensor.connect_timeout)"
            )

    def _begin_thread(self) -> threading.Thread:
        thread = threading.Thread(target=self._run, name="ft-sensor", daemon=True)
        thread.start()
        return thread

    def wait(self, timeout: float) -> bool:
        """Wait for the next sample up to ``timeout`` s; returns whether one has come."""
        self._new_sample.clear()
        return self._clock.wait(self._new_sample, timeout)

    def _why(self) -> str:
        """Return why there may be no sample, for messages."""
        dropped = self._sensor.dropped
        if self._broken:
            return f" ({self._broken})"
        return f" ({dropped} pieces of garbage dropped)" if dropped else ""

    def _report(self, error: Exception) -> str:
        """Return an error of the link as text with the sensor's name."""
        if isinstance(error, LinkError):
            return str(error)
        return f"{self._sensor.name}: {type(error).__name__}: {first_line(error)}"

    def _run(self) -> None:
        pause = BACKOFF[0]
        while not self._stopping.is_set():
            try:
                if self._broken:
                    self._sensor.connect()
                    self._broken = ""
                reading = self._sensor.read(LISTEN)
            except Exception as error:  # adapters and their libraries raise what they like
                self._sensor.close()
                self._broken = self._report(error)
                self._clock.wait(self._stopping, pause)
                pause = min(2.0 * pause, BACKOFF[1])
                continue
            if reading is not None:
                pause = BACKOFF[0]
                self._readings.append(reading)
                self._new_sample.set()

    def at(self, moment: float) -> Reading:
        """Return the reading at a ``moment`` (s, monotonic), interpolated between two samples.

        Never waits and never extrapolates: after the last sample, returns that one. Raises
        StaleStateError if it is older than ``max_age``, InvalidStateError if the sensor is
        overloaded or reports a fault.
        """
        readings = list(self._readings)
        self._require_fresh(readings)
        later = readings[-1]
        self._require_valid(later)
        for earlier in reversed(readings[:-1]):
            if later.timestamp <= moment:
                break
            if earlier.timestamp <= moment:
                self._require_valid(earlier)
                self._require_valid(later)
                return _between(earlier, later, moment)
            later = earlier
        self._require_valid(later)
        return later

    def _require_fresh(self, readings: list[Reading]) -> None:
        limit = self._settings.max_age
        age = self._clock.monotonic() - readings[-1].timestamp if readings else float("inf")
        if age > limit:
            raise StaleStateError(
                f"{self._sensor.name}: found the last sample {age:.3f} s old{self._why()}, "
                f"expected at most {limit:g} s (ft_sensor.max_age)"
            )

    def _require_valid(self, reading: Reading) -> None:
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
    """Return the interpolated reading at a moment between two."""
    share = (moment - earlier.timestamp) / max(later.timestamp - earlier.timestamp, 1e-9)
    wrench = earlier.wrench + min(share, 1.0) * (later.wrench - earlier.wrench)
    return Reading(moment, later.received, wrench)
