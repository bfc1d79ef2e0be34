"""The base class of drivers: the interface between a controller's protocol and the loop.

``connect``, ``read_state``, ``write_setpoint`` and ``close`` are what every driver has; ``arm`` and
``release`` begin and end writing. The base class checks every sample (drivers/state_check.py) and
every setpoint (drivers/gate.py): a driver implements ``_read_state``, ``_send``, ``_make_ready``
and ``_release``, and cannot bypass either check.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Self, final

from gapbridge.core.arrays import Array
from gapbridge.core.errors import RobotBusyError, WriteError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.controller_facts import ControllerFacts, Difference, differences
from gapbridge.drivers.gate import Gate
from gapbridge.drivers.state_check import FASTEST, SampleCheck

GATED = (
    "read_state",
    "write_setpoint",
    "take_lapsed",
    "arm",
    "release",
    "abandon",
)  # not to be overridden


class Driver(ABC):
    """One link to one controller, for one thread.

    Constructors and garbage collection never touch hardware: only ``connect`` opens a link, and
    only for reading. ``write_setpoint`` is the only call that moves an arm.
    """

    def __init__(
        self,
        rate: float,
        model: Model,
        moves_arm: bool = True,
        clock: Clock = SYSTEM,
        fastest: float = FASTEST,
    ) -> None:
        self.clock = clock  # its states' time stamps, and the clock that their age is measured by
        self._now = clock.monotonic
        self.rate = rate  # Hz: rate at which read_state returns samples
        self.n = model.arm.n  # joints
        self.moves_arm = moves_arm  # False: setpoints are offsets on the robot's own motion
        self.gate = Gate(rate, model, moves_arm, clock.monotonic)
        self._check = SampleCheck(model.arm, fastest)  # rad/s that no joint exceeds
        self._expiry = math.inf  # s, monotonic: of the setpoint that is being sent
        self._cell_model = model  # compared with what the controller reports

    def __init_subclass__(cls, **keys: Any) -> None:
        """Refuse a driver that bypasses check or gate. Raises TypeError."""
        super().__init_subclass__(**keys)
        for name in GATED:
            if name in cls.__dict__:
                raise TypeError(
                    f"{cls.__name__}.{name}: found a driver's own, expected _read_state, _send, "
                    "_make_ready and _release: the base checks what is read and what is written"
                )

    @abstractmethod
    def connect(self) -> None:
        """Open the link for reading. Moves nothing. Raises LinkError."""

    @final
    def read_state(self) -> RobotState:
        """Wait for the next sample of the controller and return it.

        Blocks until a sample with a new controller timestamp arrives. Raises StaleStateError if
        none arrives within the settings' timeout, InvalidStateError if it is implausible.
        """
        state = self._read_state()
        self._validate(state)
        return state

    @abstractmethod
    def _read_state(self) -> RobotState:
        """Implement ``read_state`` up to the check; raises InvalidStateError for a torn sample."""

    def _validate(self, state: RobotState) -> None:
        """Compare a sample with the arm's limits and with the previous sample.

        Raises InvalidStateError. A driver that stores samples extends this method.
        """
        self._check.check(state)

    def reset_check(self) -> None:
        """Accept the next sample without comparing it with the previous one."""
        self._check.reset()

    def _offset_rates(self) -> tuple[float, float]:
        """Return the cell's rates of the offset, m/s and rad/s."""
        return self.gate.bounds.offset_rate, self.gate.bounds.offset_rotation_rate

    @final
    def write_setpoint(self, setpoint: Setpoint, expiry: float = math.inf) -> None:
        """Send one setpoint from the limiter; needs ``arm`` before.

        ``expiry`` (s, monotonic): a setpoint that a last message triggers is not triggered later.
        Raises WriteError; GateError if the gate refuses it, and RobotBusyError from a robot that
        moves from target to target and is still on its way (LateSetpointError after ``expiry``):
        then nothing has taken effect.
        """
        self.gate.check(setpoint)
        self._expiry = expiry
        try:
            self._send(setpoint)
        except RobotBusyError:
            self.gate.sent()  # the stream goes on: steps are judged between its setpoints
            raise
        self.gate.sent()

    @abstractmethod
    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint that has passed the gate; see ``write_setpoint``."""

    def _send_for(self, outer: Driver, setpoint: Setpoint) -> None:
        """Send a setpoint that has passed the gate of ``outer``, the driver around this one."""
        self._expiry = outer._expiry
        self._send(setpoint)

    @final
    def take_lapsed(self) -> bool:
        """Return, once, whether the setpoint sent last never took effect: it had become too old.

        The one before it is in force; the stream must go on from that.
        """
        lapsed = self._take_lapsed()
        if lapsed:
            self.gate.take_back()
        return lapsed

    def _take_lapsed(self) -> bool:
        """Implement ``take_lapsed``; only a driver whose setpoints wait for a message has any."""
        return False

    @abstractmethod
    def close(self) -> None:
        """Close the link; an arm moved by setpoints stops. Never raises; may be repeated."""

    @final
    def arm(self, state: RobotState) -> list[Difference]:
        """Prepare for writing; may take seconds and never moves the arm. Raises WriteError.

        ``state`` is the sample read last; it is stale afterwards. Refuses if the controller's arm,
        TCP or gravity differ from the cell's; returns the other differences.
        """
        self.gate.end()
        differing = self.differences(state)
        for difference in differing:
            if difference.sure:
                raise WriteError(f"{difference} (gapbridge check --live)")
        self._make_ready(state)
        self.gate.begin(state.target_q, state.actual_q)
        return differing

    def _make_ready(self, state: RobotState) -> None:
        """Implement ``arm``; see there."""

    def facts(self, state: RobotState) -> ControllerFacts:
        """Return what the controller reports about its arm; ``state`` is the sample read last.

        Reads only. Raises LinkError if the controller does not answer.
        """
        return ControllerFacts(
            n=len(state.actual_q), payload=state.payload, payload_cog=state.payload_cog,
            q=state.actual_q,
        )  # fmt: skip

    def differences(self, state: RobotState) -> list[Difference]:
        """Return the differences between cell and controller. Raises LinkError."""
        return differences(self.facts(state), self._cell_model, self.rate)

    def keep_alive(self) -> None:
        """Feed the robot's watchdog, which may block; called before each setpoint.

        Raises WriteError.
        """

    @final
    def release(self) -> None:
        """Stop writing: the arm comes to rest and the controller is as before ``arm``.

        Does not ramp out an offset: the limiter has done so, or the robot's program does it at the
        cell's rates. May take seconds. Raises WriteError if the link is lost.
        """
        self.gate.end()
        self._release()

    def _release(self) -> None:
        """Implement ``release``; see there."""

    @final
    def abandon(self) -> None:
        """Stop writing in a fault: as ``release``, but no setpoint is sent any more.

        Raises WriteError if the link is lost.
        """
        self.gate.end()
        self._abandon()

    def _abandon(self) -> None:
        """Implement ``abandon``; a driver whose release sends setpoints has one of its own."""
        self._release()

    def round_trip(self) -> float | None:
        """Return the round-trip time of a request now, s; None if the link has no requests.

        It bounds the age of a state; measured before arming. Raises WriteError if no answer comes.
        """
        return None

    def take_round_trip(self) -> float | None:
        """Return, once, a round-trip time measured since arming, s; None: no new one.

        Never waits; called in each cycle, so that a delay that grows is not taken for a
        clock that drifts. Only a link with a clock of the controller needs it.
        """
        return None

    def transit_time(self) -> float:
        """Return an upper bound of the last sample's transit time from the controller, s.

        Only the part that timestamps do not show; read in each cycle. 0: not known.
        """
        return 0.0

    def unanswered_since(self) -> float:
        """Return when the oldest unacknowledged setpoint was sent, s monotonic; infinite: none.

        A sample that acknowledges a setpoint was taken after it was sent, whatever the clocks say.
        Infinite too where the link acknowledges none.
        """
        return math.inf

    def mismatch(self) -> str | None:
        """Return how the controller's settings differ from the cell's, as text; None: they agree.

        Called about once a second while the arm is armed; None too where the link cannot tell.
        """
        return None

    def nominal_q(self, state: RobotState) -> Array:
        """Return the robot's own target joints (n,), without our correction, rad."""
        return state.target_q

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
