"""Any arm's driver joined with a force-torque sensor: one driver for the loop."""

from __future__ import annotations

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.setpoint import Setpoint
from gapbridge.core.state import RobotState
from gapbridge.drivers.controller_facts import ControllerFacts, Difference
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor import make_sensor
from gapbridge.drivers.ft_sensor.clock_offset import ClockOffset
from gapbridge.drivers.ft_sensor.reader import SensorReader
from gapbridge.drivers.ft_sensor.settings import FtSensorSettings
from gapbridge.drivers.ft_sensor.wrench import TcpForce, sensor_to_flange


class DriverWithSensor(Driver):
    """An arm's driver whose states carry the wrench of a sensor on the flange.

    The arm's clock is tied to this machine's by the quickest arrivals, the sensor's samples carry
    this machine's time, and each state gets the wrench of the moment it was sampled at. The arm's
    cycle never waits for the sensor.
    """

    def __init__(self, arm: Driver, settings: FtSensorSettings, model: Model) -> None:
        super().__init__(arm.rate, model, arm.moves_arm, arm.clock)
        self.gate = arm.gate
        self.settings = settings
        self._arm = arm
        self._reader = SensorReader(make_sensor(settings), settings)
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

        Where the sensor is silent, overloaded or not well, the state has no force and says why; or,
        with ``when_lost: stop``, raises StaleStateError, InvalidStateError.
        """
        state = self._arm.read_state()
        moment = self._clock.take(state.timestamp, state.received)
        try:
            raw = self._to_flange @ self._reader.at(moment).wrench
        except (StaleStateError, InvalidStateError) as error:
            if self.settings.when_lost == "stop":
                raise
            force = state.actual_TCP_force if self._tcp_force is None else np.full(6, np.nan)
            return state._replace(
                ft_raw_wrench=None, actual_TCP_force=force, sensor_lost=str(error)
            )
        if self._tcp_force is None:
            return state._replace(ft_raw_wrench=raw)
        force = self._tcp_force.of(raw, state)
        return state._replace(ft_raw_wrench=raw, actual_TCP_force=force)

    def forget(self) -> None:
        """See Driver.forget."""
        super().forget()
        self._arm.forget()

    def keep_alive(self) -> None:
        """See Driver.keep_alive."""
        self._arm.keep_alive()

    def round_trip(self) -> float | None:
        """See Driver.round_trip."""
        return self._arm.round_trip()

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
        """Send one setpoint to the arm."""
        self._arm.write_setpoint(setpoint)

    def close(self) -> None:
        """Leave both links."""
        try:
            self._arm.close()
        finally:
            self._reader.stop()

    def _make_ready(self, state: RobotState) -> None:
        """Make the arm ready, and see that the sensor has not been held up by it."""
        self._arm.arm(state)
        if not self._reader.wait(self.settings.connect_timeout):
            raise WriteError(
                f"found no sample of the sensor within {self.settings.connect_timeout:g} s of "
                "arming (ft_sensor.connect_timeout)"
            )

    def _let_go(self) -> None:
        """Stop writing to the arm."""
        self._arm.release()

    def nominal_q(self, state: RobotState) -> Array:
        """Return the joints (n,) that the robot itself wants, rad."""
        return self._arm.nominal_q(state)
