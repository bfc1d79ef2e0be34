"""The UR driver: reading and writing halves put together."""

from __future__ import annotations

import math

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.compensation import wanted_pose
from gapbridge.core.errors import InvalidStateError, LinkError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.rotation import one_rotation_matrix
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.controller_facts import TCP_TURNED, ControllerFacts, Difference, differences
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.offset_inverse import Nominal
from gapbridge.drivers.ur_rtde.command import OffsetWriter, ServoWriter
from gapbridge.drivers.ur_rtde.enquiry import RoundTrip, enquire
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings
from gapbridge.drivers.ur_rtde.state import StateReader


class UrRtdeDriver(Driver):
    """One UR arm over RTDE. ``settings.mode``: how setpoints are sent.

    Use it in a process that may be killed: the library can hang, abort or crash it when the link
    breaks. After a LinkError the object cannot be used again: start a new process.
    """

    def __init__(self, settings: UrRtdeSettings, model: Model, clock: Clock) -> None:
        super().__init__(settings.rate, model, settings.mode == "servoj", clock)
        if model.arm.n != 6:
            raise LinkError(f"link: found an arm of {model.arm.n} joints, a UR has 6")
        self.settings = settings
        self.reader = StateReader(settings, clock)
        self._model, self._nominal = model, Nominal(model)
        self._writer: ServoWriter | OffsetWriter = (
            ServoWriter(settings, clock)
            if settings.mode == "servoj"
            else OffsetWriter(settings, self._offset_rates, clock)
        )
        self._state: RobotState | None = None
        self._question = RoundTrip(settings.host, clock)
        self._round_trip = 0.0  # s: the round trip when armed last

    def connect(self) -> None:
        """Open the receiving side only: changes no program and claims no input."""
        self.reader.open()

    def _read_state(self) -> RobotState:
        """Return the next sample; see Driver.read_state."""
        self._state = self.reader.read()
        if isinstance(self._writer, OffsetWriter):
            self._writer.note_answer(self.reader.echo, self.reader.program, self.reader.applied)
        return self._state

    def _look(self) -> RobotState | None:
        """Return a sample while arming; None: one that is not valid. Raises WriteError."""
        try:
            return self.read_state()
        except InvalidStateError:
            return None
        except LinkError as error:
            raise WriteError(str(error)) from None

    def nominal_q(self, state: RobotState) -> Array:
        """Return the robot's own target joints (6,), rad.

        Offset mode: ``target_q`` without the offset that the robot's program applied in that cycle
        (see drivers/offset_inverse.py), of the sample read last. servoj mode: ``target_q``.
        """
        if self.moves_arm:
            return state.target_q
        return self._nominal.without(state.target_q, self.reader.applied)

    def _make_ready(self, state: RobotState) -> None:
        """Prepare for writing: upload the control script, or claim the registers."""
        message = self.mismatch()
        if message is not None:
            raise WriteError(f"{self.settings.host}: {message}")
        self._writer.arm(state, self._look)

    def round_trip(self) -> float | None:
        """Return the round-trip time of an RTDE request, s; see Driver.round_trip."""
        self._round_trip = duration = self._question.measure()
        return duration

    def take_round_trip(self) -> float | None:
        """Return a round-trip time measured since, s; see Driver.take_round_trip."""
        return self._question.poll()

    def transit_time(self) -> float:
        """Return the round-trip time measured when arming, s; see Driver.transit_time."""
        return self._round_trip

    def unanswered_since(self) -> float:
        """Return when the oldest offset not accepted by the robot's program was sent, s.

        See Driver.unanswered_since; servoJ is not acknowledged.
        """
        writer = self._writer
        return writer.unanswered_since() if isinstance(writer, OffsetWriter) else math.inf

    def mismatch(self) -> str | None:
        """Return how the controller's TCP differs from the cell's; see Driver.mismatch.

        Offset mode only: offsets act at the controller's TCP, joint setpoints do not.
        """
        q_and_tcp = None if self.moves_arm else self.reader.joints_and_tcp()
        if q_and_tcp is None:
            return None
        q, tcp = q_and_tcp
        wanted = wanted_pose(self._model, q[None])
        apart = float(np.linalg.norm(tcp[:3] - wanted.position[0]))
        cosine = 0.5 * (np.trace(one_rotation_matrix(tcp[3:]).T @ wanted.rotation[0]) - 1.0)
        turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        most = self.settings.tcp_tolerance
        if apart <= most and turned <= TCP_TURNED:  # NaN is not
            return None
        return (
            f"the controller's TCP is {1e3 * apart:.1f} mm and {turned:.3f} rad from the cell's, "
            f"expected at most {1e3 * most:g} mm (link.tcp_tolerance) and {TCP_TURNED:g} rad: set "
            "the same TCP in both (tool.tcp in the cell file; robot.calibration beside it)"
        )

    def facts(self, state: RobotState) -> ControllerFacts:
        """Return what RTDE and the primary interface report; see Driver.facts."""
        return enquire(self.settings.host, self.clock)

    def differences(self, state: RobotState) -> list[Difference]:
        """Return where the cell differs; see Driver.differences. Raises WriteError."""
        try:
            facts = self.facts(state)
        except LinkError as error:
            raise WriteError(str(error)) from None
        found = differences(facts, self._model, self.rate, self.settings.tcp_tolerance)
        # offset mode: ``mismatch`` compares the TCP pose, when arming and while armed
        return found if self.moves_arm else [d for d in found if d.keys[0] != "tool"]

    def keep_alive(self) -> None:
        """Feed the watchdog of the control script; see Driver.keep_alive."""
        self._writer.keep_alive()

    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint; needs ``arm`` before."""
        state = self._state
        if state is None:
            raise WriteError(f"{self.settings.host}: found no state, expected read_state() first")
        self._writer.write(setpoint, state)

    def _release(self) -> None:
        """Stop writing: servoStop and end of the script, or no more heartbeats."""
        self._question.close()
        if self.reader.age > self.settings.state_timeout:
            raise WriteError(f"{self.settings.host}: the link is silent; the robot's watchdog acts")
        self._writer.release()

    def close(self) -> None:
        """Release if the link works, drop the library's objects, and disconnect."""
        try:
            self.release()
        except LinkError:
            pass
        finally:
            self._writer.abandon()
            self._question.close()
            self.reader.close()
