"""What a driver is: four methods between a controller's wire and the loop.

``connect``, ``read_state``, ``write_setpoint`` and ``close`` are what every driver has; ``arm`` and
``release`` begin and end the writing. Whatever is read passes the check (drivers/state_check.py)
and whatever is written the gate (drivers/gate.py) here, in the base: a driver implements
``_read_state``, ``_send``, ``_make_ready`` and ``_let_go``, and cannot go around either.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, Self, final

from gapbridge.core.arrays import Array
from gapbridge.core.errors import WriteError
from gapbridge.core.model import Model
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.controller_facts import ControllerFacts, Difference, differences
from gapbridge.drivers.gate import Gate
from gapbridge.drivers.state_check import FASTEST, SampleCheck

GATED = ("read_state", "write_setpoint", "arm", "release")  # of the base alone


class Driver(ABC):
    """One link to one controller, for one thread.

    Constructors never touch hardware, nor does garbage collection: only ``connect`` opens a link,
    and only the side that reads. ``write_setpoint`` is the only call after which an arm moves.
    """

    def __init__(
        self,
        rate: float,
        model: Model,
        moves_arm: bool = True,
        clock: Clock = SYSTEM,
        fastest: float = FASTEST,
    ) -> None:
        self.clock = clock  # what its states are stamped by, and all who judge their age
        self._now = clock.monotonic
        self.rate = rate  # Hz: cycles per second that read_state is paced at
        self.n = model.arm.n  # joints
        self.moves_arm = moves_arm  # setpoints are the arm's motion; False: they ride on its own
        self.gate = Gate(rate, model, moves_arm, clock.monotonic)
        self._check = SampleCheck(model.arm, fastest)  # rad/s that no joint can pass
        self._cell_model = model  # what the controller is compared with

    def __init_subclass__(cls, **keys: Any) -> None:
        """Refuse a driver that goes around check or gate. Raises TypeError."""
        super().__init_subclass__(**keys)
        for name in GATED:
            if name in cls.__dict__:
                raise TypeError(
                    f"{cls.__name__}.{name}: found a driver's own, expected _read_state, _send, "
                    "_make_ready and _let_go: the base checks what is read and what is written"
                )

    @abstractmethod
    def connect(self) -> None:
        """Open the link for reading. Moves nothing. Raises LinkError."""

    @final
    def read_state(self) -> RobotState:
        """Wait for the next sample of the controller and return it.

        Blocks until a sample with a new controller timestamp is there. Raises StaleStateError where
        none comes within the settings' timeout, InvalidStateError where it cannot be believed.
        """
        state = self._read_state()
        self._validate(state)
        return state

    @abstractmethod
    def _read_state(self) -> RobotState:
        """Do what ``read_state`` promises, up to the check; a torn sample is refused here."""

    def _validate(self, state: RobotState) -> None:
        """Compare a sample with the arm's limits and with the one before.

        Raises InvalidStateError. A driver that remembers samples does it here, after this.
        """
        self._check.check(state)

    def forget(self) -> None:
        """Take the next sample without comparing it to the ones before."""
        self._check.forget()

    @final
    def write_setpoint(self, setpoint: Setpoint) -> None:
        """Send one setpoint that came out of the limiter; needs ``arm`` before.

        Raises WriteError: GateError where the gate refuses it, and then nothing was sent.
        """
        self.gate.check(setpoint)
        self._send(setpoint)
        self.gate.sent()

    @abstractmethod
    def _send(self, setpoint: Setpoint) -> None:
        """Send one setpoint that has passed the gate. Raises WriteError."""

    @abstractmethod
    def close(self) -> None:
        """Leave the link: the arm stops where setpoints moved it. Never raises; may be repeated."""

    @final
    def arm(self, state: RobotState) -> list[Difference]:
        """Make ready for writing; may take seconds and never moves the arm. Raises WriteError.

        ``state`` is the sample last read; states read before are stale afterwards. Refuses where
        the controller's arm, TCP or gravity are not the cell's; returns what else differs.
        """
        self.gate.end()
        differing = self.differences(state)
        for wrong in differing:
            if wrong.sure:
                raise WriteError(f"{wrong} (gapbridge check --live)")
        self._make_ready(state)
        self.gate.begin(state.target_q, state.actual_q)
        return differing

    def _make_ready(self, state: RobotState) -> None:
        """Do what ``arm`` promises; see there."""

    def facts(self, state: RobotState) -> ControllerFacts:
        """Return what the controller says of its arm; ``state`` is the sample last read.

        Reads only. Raises LinkError where it has to be asked and does not answer.
        """
        return ControllerFacts(
            n=len(state.actual_q), payload=state.payload, payload_cog=state.payload_cog,
            q=state.actual_q,
        )  # fmt: skip

    def differences(self, state: RobotState) -> list[Difference]:
        """Return where the cell differs from what the controller says. Raises LinkError."""
        return differences(self.facts(state), self._cell_model, self.rate)

    def keep_alive(self) -> None:
        """Feed the robot's own watchdog where that may wait; before each setpoint.

        Raises WriteError.
        """

    @final
    def release(self) -> None:
        """Stop writing: the arm comes to rest and the controller is as before ``arm``.

        Takes no offset out by itself: the limiter has done that, or the robot's program does it at
        the cell's rates. May take a while. Raises WriteError where the link is gone.
        """
        self.gate.end()
        self._let_go()

    def _let_go(self) -> None:
        """Do what ``release`` promises; see there."""

    def round_trip(self) -> float | None:
        """Return how long a question and its answer take now, s; None where nothing can be asked.

        No state is younger than that way lets it be: asked before arming. Raises WriteError where
        no answer comes.
        """
        return None

    def way(self) -> float:
        """Return the longest time, s, that the last sample may have been under way to here.

        Beyond what its timestamp shows beside those before; asked in each cycle. 0: not known.
        """
        return 0.0

    def unanswered_since(self) -> float:
        """Return when the oldest setpoint left that the last sample does not answer, s monotonic.

        A sample that answers all that left before some moment was taken after it, whatever clocks
        say. Infinite where there is none, or the link answers none.
        """
        return math.inf

    def mismatch(self) -> str | None:
        """Return in words how the controller is set otherwise than the cell says; None: it is not.

        Asked about once a second while the arm is armed; where the link does not show it: None.
        """
        return None

    def nominal_q(self, state: RobotState) -> Array:
        """Return the joints (n,) that the robot itself wants, without our correction, rad."""
        return state.target_q

    def __enter__(self) -> Self:
        self.connect()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
