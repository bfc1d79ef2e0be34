"""Writing: Setpoint -> wire, by servoJ or as an offset in RTDE input registers.

Independent of reading. Neither mode confirms a setpoint: the library's True only means that a call
was made. The confirmation is in the samples that follow: target joints that follow a setpoint, the
sequence number that comes back.
"""

from __future__ import annotations

import contextlib
import math
import os
import socket
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gapbridge.core.errors import WriteError, first_line
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.robot_modes import (
    PAUSED,
    PLAYING,
    PROGRAM_STOPPED,
    PROGRAM_STOPPING,
    why_not_ready,
)
from gapbridge.drivers.ur_rtde import registers
from gapbridge.drivers.ur_rtde.enquiry import RTDE
from gapbridge.drivers.ur_rtde.registers import Program
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

NO_REMOTE_CHECK = 0x80  # FLAG_DISABLE_REMOTE_CONTROL_CHECK
KICK = 0.02  # s between kicks of the watchdog
FOLLOWING = 0.02  # rad: largest distance of the controller's target from recent setpoints
ECHO_SAMPLES, ANNOUNCE_TIMEOUT = 8, 0.3  # samples per attempt and s for all, until the first echo
LONGEST_STOPPING = 1.0  # s that a program takes to stop, as our own does after a release
DECIMATION, KEPT = 5, 64  # every so many setpoints one is stored; how many are stored
DESCRIPTORS = Path("/proc/self/fd")  # the open sockets of this process
CONTROL = (
    "setWatchdog", "kickWatchdog", "servoJ", "servoStop", "stopScript", "reuploadScript",
    "isConnected", "isProgramRunning",
)  # fmt: skip
DOUBLES = frozenset(registers.OFFSET_DOUBLES)
INTEGERS = frozenset((
    registers.OFFSET_RZ, registers.SEQUENCE, registers.CHECKSUM, registers.HEARTBEAT,
    registers.RATES,
))  # fmt: skip
"""Calls and registers that may be used. The library's control script can run any motion and set any
output, and RTDE inputs are anybody's: whatever these lists lack raises before the socket."""


Look = Callable[[], RobotState | None]  # None: the sample is not valid

_ABANDONED: list[Any] = []
"""Library objects of dead links: destroying them hangs or crashes the process, so they are kept
until it ends by ``os._exit``."""


def check_ready(host: str, state: RobotState) -> None:
    """Refuse a robot that cannot move. Raises WriteError."""
    if detail := why_not_ready(state):
        raise WriteError(
            f"{host}: found {detail}, expected robot_mode 7 (running), safety_mode 1 (normal) or "
            "2 (reduced), and no stop"
        )


class ServoWriter:
    """Joint setpoints by servoJ, through the control script that the library uploads."""

    def __init__(self, settings: UrRtdeSettings, clock: Clock) -> None:
        self._clock, self._now = clock, clock.monotonic
        self._settings = settings
        self._control: Any = None
        self._connection: frozenset[str] = frozenset()  # of the library for writing
        self._period = 1.0 / settings.rate
        self._kicked = 0.0
        self._sent = np.zeros((KEPT, 6))
        self._sent_at = np.zeros(KEPT)
        self._count = 0

    def arm(self, state: RobotState, look: Look) -> None:
        """Upload the control script and start the robot's watchdog. Raises WriteError."""
        host = self._settings.host
        until = self._now() + LONGEST_STOPPING
        state = look() or state  # the controller was compared with the cell since, for seconds
        while state.runtime_state == PROGRAM_STOPPING and self._now() < until:
            state = look() or state
        check_ready(host, state)
        if state.runtime_state != PROGRAM_STOPPED:
            number = state.runtime_state
            what = {PLAYING: "running", PAUSED: "paused"}.get(number, f"in runtime_state {number}")
            raise WriteError(
                f"{host}: found a program {what} on the controller, expected none: link.mode "
                "'servoj' would end it; stop it (an arming that was interrupted leaves its control "
                "script), or use link.mode 'offset'"
            )
        if self._control is None:
            self._control = self._open()
        elif not self._control.isProgramRunning():
            self._clear_command()
            self._control.reuploadScript()
            self._wait_running()
        if not self._control.setWatchdog(self._settings.watchdog):
            with contextlib.suppress(WriteError):
                self.release()  # else our own script is what the next arming is refused for
            raise WriteError(f"{host}: the controller refused the watchdog")
        self._count, self._kicked = 0, 0.0

    def _open(self) -> Any:
        from rtde_control import RTDEControlInterface

        settings = self._settings
        flags = RTDEControlInterface.FLAG_UPLOAD_SCRIPT
        if not settings.remote_control:
            flags |= NO_REMOTE_CHECK
        before = connections(RTDE)
        try:
            library = RTDEControlInterface(settings.host, settings.rate, flags)
            self._connection = connections(RTDE) - before
            send_at_once()
            return AllowedControl(settings.host, library)
        except Exception as error:
            raise WriteError(f"{settings.host}: {first_line(error)}") from None

    def _wait_running(self) -> None:
        """Wait until an uploaded script runs: the library returns before it does."""
        until = self._now() + 2.0
        while not self._control.isProgramRunning():
            if self._now() > until:
                raise WriteError(f"{self._settings.host}: the control script does not start")
            self._clock.sleep(0.01)
        self._clock.sleep(0.05)

    def keep_alive(self) -> None:
        """Kick the watchdog, which blocks until the script has received it.

        Call it before servoJ, which writes the same register and must write last.
        """
        now = self._now()
        if now - self._kicked > KICK:
            self._running().kickWatchdog()
            self._kicked = now
            self._check_connection()

    def _check_connection(self) -> None:
        """Raise WriteError where the library has replaced a connection that had ended.

        By itself it uploads its script anew amid the motion, and goes on as if nothing had been:
        without the robot's watchdog, which ended with the script before.
        """
        if self._connection and not self._connection <= connections():
            raise WriteError(
                f"{self._settings.host}: the library's connection for writing has ended and was "
                "replaced: the robot's watchdog is not set any more"
            )

    def _running(self) -> Any:
        """Return the library's object while its script runs. Raises WriteError."""
        control, host = self._control, self._settings.host
        if control is None:
            raise WriteError(f"{host}: found no control script, expected arm() first")
        if not control.isConnected():
            raise WriteError(f"{host}: the library's connection for writing has ended")
        if not control.isProgramRunning():
            raise WriteError(
                f"{host}: the control script has ended (watchdog, a stop, or a person)"
            )
        return control

    def write(self, setpoint: Setpoint, state: RobotState) -> None:
        """Send one setpoint. Raises WriteError if the robot does not follow."""
        control, settings = self._running(), self._settings
        if self._now() - self._kicked > 0.4 / self._settings.watchdog:
            self.keep_alive()  # if the caller does not
        self._check_following(setpoint, state)
        if not control.servoJ(
            setpoint.q.tolist(), 0.0, 0.0, self._period, settings.lookahead, settings.gain
        ):
            raise WriteError(f"{settings.host}: the controller refused servoJ")

    def _check_following(self, setpoint: Setpoint, state: RobotState) -> None:
        """Compare the controller's target with the recent setpoints.

        servoJ returns True even if nothing arrives; a target outside the range of the setpoints
        sent within ``link.following`` s is the only sign of it.
        """
        count, self._count = self._count, self._count + 1
        if count % DECIMATION:
            return
        now = self._now()
        slot = count // DECIMATION % KEPT
        oldest = self._sent_at[slot] if count >= DECIMATION * KEPT else self._sent_at[0]
        self._sent[slot], self._sent_at[slot] = setpoint.q, now
        if count == 0 or now - oldest < self._settings.following:
            return
        recent = self._sent[self._sent_at >= now - self._settings.following]
        low, high = recent.min(axis=0) - FOLLOWING, recent.max(axis=0) + FOLLOWING
        if (state.target_q < low).any() or (state.target_q > high).any():
            joint = int(np.argmax(np.abs(state.target_q - setpoint.q)))
            raise WriteError(
                f"{self._settings.host}: setpoints do not arrive: joint {joint + 1} has a target "
                f"of {state.target_q[joint]:.4f} rad, and {setpoint.q[joint]:.4f} rad was sent"
            )

    def release(self) -> None:
        """Brake the arm and end the control script. Raises WriteError where that failed."""
        control = self._control
        if control is None:
            return
        if not control.isProgramRunning():
            self._clear_command()  # the script may be paused, and a person may let it go on
            return
        stopped = control.servoStop(self._settings.stop_deceleration)
        control.stopScript()
        if not stopped:
            raise WriteError(f"{self._settings.host}: the controller refused servoStop")

    def _clear_command(self) -> None:
        """Clear the command register, which outlives a script. Raises WriteError.

        A script that is resumed or uploaded would go to the last target at once, wherever the arm
        is by then. Where no script runs, this is all that the library's stopScript does.
        """
        if self._control.isConnected():
            self._control.stopScript()

    def abandon(self) -> None:
        """Keep the control object undestroyed: destroying it on a dead link is not safe."""
        if self._control is not None:
            _ABANDONED.append(self._control)
            self._control = None


class OffsetWriter:
    """Offsets in RTDE input registers, applied by the robot's own program.

    One call sends one register, so an offset arrives in nine packets; the sequence number goes
    last, and the checksum shows the program whether they belong together. ``rates`` (m/s, rad/s)
    are the cell's: the program ramps offsets in and out no faster, also when nothing is sent.
    """

    def __init__(
        self,
        settings: UrRtdeSettings,
        rates: Callable[[], tuple[float, float]],
        clock: Clock,
    ) -> None:
        self._now = clock.monotonic
        self._settings, self._cell_rates = settings, rates
        self._io: Any = None
        self._sequence = self._rates = 0
        # sequence numbers not echoed yet, and when each was sent, s monotonic
        self._unanswered: deque[tuple[int, float]] = deque()
        self._echo = 0
        self._program = 0
        self._applied: Sequence[float] | np.ndarray = ()

    def note_answer(self, echo: int, program: int, applied: Sequence[float] | np.ndarray) -> None:
        """Store the program's answer: last sequence accepted, its state, offset applied (6,)."""
        self._echo, self._program, self._applied = echo, program, applied
        unanswered = self._unanswered
        while unanswered and registers.reached(echo, unanswered[0][0]):
            unanswered.popleft()

    def unanswered_since(self) -> float:
        """Return when the oldest offset not echoed yet was sent, s monotonic; infinite: none."""
        return self._unanswered[0][1] if self._unanswered else math.inf

    def arm(self, state: RobotState, look: Look) -> None:
        """Open the registers and send the rates. Raises WriteError if the program does not run.

        Waits until the program has ramped out any former offset, and sends an offset of zero.
        """
        host = self._settings.host
        check_ready(host, state)
        if self._program == Program.ABSENT or state.runtime_state != PLAYING:
            raise WriteError(
                f"{host}: output_int_register_{registers.PROGRAM}: found {self._program} with "
                f"runtime_state {state.runtime_state}, expected a running robot program that holds "
                "gapbridge_offset.script"
            )
        try:
            self._rates = registers.rates(*self._cell_rates())
        except ValueError as error:
            raise WriteError(f"limits.{error}: what the robot's program can be given") from None
        self._wait_for_zero_offset(look)
        if self._io is None:
            self._io = self._open()
        # a number that differs from the last one that the program has seen
        self._sequence = (self._echo + registers.LAST_SEQUENCE // 4) % registers.LAST_SEQUENCE
        self._unanswered.clear()
        self._announce(look)

    def _open(self) -> AllowedInputs:
        host = self._settings.host
        try:
            from rtde_io import RTDEIOInterface

            io = AllowedInputs(host, RTDEIOInterface(host))
            send_at_once()
        except Exception as error:
            raise WriteError(f"{host}: {first_line(error)}") from None
        return io

    def _wait_for_zero_offset(self, look: Look) -> None:
        """Wait until the program has ramped out the offset of a former session, at its rates.

        Raises WriteError.
        """
        until = self._now() + 0.5 * self._settings.connect_timeout
        while (length := float(np.abs(self._applied).max(initial=0.0))) > registers.UNIT:
            if self._now() > until:
                raise WriteError(
                    f"{self._settings.host}: the robot's program still applies an offset of "
                    f"{1e3 * length:.3f} mm or mrad, expected none before arming: it takes it out "
                    "by itself, at the rates it was last given"
                )
            look()

    def _announce(self, look: Look) -> None:
        """Send rates and an offset of zero until the program answers. Raises WriteError."""
        self._set(lambda io: io.setInputIntRegister(registers.RATES, self._rates))
        until = self._now() + max(self._settings.echo, ANNOUNCE_TIMEOUT)
        while True:
            self._sequence = registers.next_sequence(self._sequence)
            first = self._sequence
            self._send([0] * 6)
            for _ in range(ECHO_SAMPLES):
                look()
                if registers.reached(self._echo, first):
                    return
            if self._now() > until:
                raise WriteError(
                    f"{self._silence()}: is it the gapbridge_offset.script of this version?"
                )

    def keep_alive(self) -> None:
        """Raise WriteError if an offset has not been accepted in time, or the program is gone.

        The sequence number of each offset is the heartbeat.
        """
        if self._program == Program.ABSENT:
            raise WriteError(
                f"{self._settings.host}: output_int_register_{registers.PROGRAM}: found 0, "
                f"expected {Program.RUNNING:d}: the robot's program has ended"
            )
        late = self._now() - self.unanswered_since()
        if late > self._settings.echo:
            raise WriteError(f"{self._silence()} (sent {late:.3f} s ago)")

    def write(self, setpoint: Setpoint, state: RobotState) -> None:
        """Send one offset. Raises WriteError if the program has stopped accepting them."""
        if self._io is None:
            raise WriteError(f"{self._settings.host}: found no registers, expected arm() first")
        self.keep_alive()  # if the caller does not
        self._sequence = registers.next_sequence(self._sequence)
        self._unanswered.append((self._sequence, self._now()))
        self._send(registers.counts(setpoint.offset_in_base.tolist()))

    def _send(self, units: list[int]) -> None:
        self._set(lambda io: self._fill(io, units))

    def _fill(self, io: Any, units: list[int]) -> bool:
        sequence, fine = self._sequence, True
        total = registers.checksum(units, sequence, self._rates)
        for register, count in zip(registers.OFFSET_DOUBLES, units[:5], strict=True):
            fine &= io.setInputDoubleRegister(register, count * registers.UNIT)
        fine &= io.setInputIntRegister(registers.OFFSET_RZ, units[5])
        fine &= io.setInputIntRegister(registers.CHECKSUM, total)
        fine &= io.setInputIntRegister(registers.HEARTBEAT, sequence)
        fine &= io.setInputIntRegister(registers.SEQUENCE, sequence)
        return bool(fine)

    def _set(self, fill: Callable[[Any], bool]) -> None:
        try:
            fine = fill(self._io)
        except Exception as error:
            raise WriteError(f"{self._settings.host}: registers: {error}") from None
        if not fine:
            raise WriteError(f"{self._settings.host}: the library refused a register")

    def _silence(self) -> str:
        reason = Program(self._program).name if self._program in (0, 1, 2, 3) else self._program
        number = self._unanswered[0][0] if self._unanswered else self._sequence
        return (
            f"{self._settings.host}: offsets do not arrive: number {number} was sent, "
            f"{self._echo} came back last, the robot's program says {reason}"
        )

    def release(self) -> None:
        """Send nothing more: without a heartbeat the program ramps out the offset.

        At the rates it was given; a zero from here would be a step.
        """

    def abandon(self) -> None:
        """Keep the library's object undestroyed: destroying it on a dead link aborts."""
        if self._io is not None:
            _ABANDONED.append(self._io)
            self._io = None


class AllowedControl:
    """The library's control interface with the calls of CONTROL and no others."""

    def __init__(self, host: str, library: Any) -> None:
        self._host, self._library = host, library  # kept: destroying it is not safe
        for name in CONTROL:
            setattr(self, name, self._call_of(name))

    def _call_of(self, name: str) -> Callable[..., Any]:
        """Return a call of the library that raises WriteError where the library raises."""
        known = getattr(self._library, name)

        def call(*given: Any) -> Any:
            try:
                return known(*given)
            except Exception as error:  # RuntimeError of a connection that has ended
                raise WriteError(f"{self._host}: {name}: {first_line(error)}") from None

        return call

    def __getattr__(self, name: str) -> Any:
        """Refuse every other call. Raises WriteError."""
        raise WriteError(f"{self._host}: {name}: is not among the calls that may be made")


class AllowedInputs:
    """The library's inputs with the registers of the offset and no others."""

    def __init__(self, host: str, library: Any) -> None:
        self._host, self._library = host, library
        self._double: Callable[[int, float], bool] = library.setInputDoubleRegister
        self._integer: Callable[[int, int], bool] = library.setInputIntRegister

    def setInputDoubleRegister(self, register: int, value: float) -> bool:
        """Write a double register. Raises WriteError for one that is not allowed."""
        if register not in DOUBLES:
            self._refuse("input_double_register", register)
        return self._double(register, value)

    def setInputIntRegister(self, register: int, value: int) -> bool:
        """Write an integer register. Raises WriteError for one that is not allowed."""
        if register not in INTEGERS:
            self._refuse("input_int_register", register)
        return self._integer(register, value)

    def _refuse(self, kind: str, register: int) -> None:
        raise WriteError(f"{self._host}: {kind}_{register}: is not among the registers written")


def send_at_once() -> int:
    """Have every TCP connection of this process send at once; returns how many there are.

    The library leaves Nagle's algorithm on, under which a setpoint waits up to 40 ms until the one
    before is acknowledged, and gives no access to its sockets; the system does. Does nothing where
    the system does not list descriptors.
    """
    if not DESCRIPTORS.is_dir():
        return 0
    return sum(_send_at_once(int(name)) for name in os.listdir(DESCRIPTORS))


def connections(port: int | None = None) -> frozenset[str]:
    """Return the sockets of this process, or those that are connected to a port.

    Each has a name of its own in the system. Empty where the system does not list descriptors.
    """
    found: set[str] = set()
    for name in os.listdir(DESCRIPTORS) if DESCRIPTORS.is_dir() else ():
        with contextlib.suppress(OSError):
            target = os.readlink(f"{DESCRIPTORS}/{name}")
            if target.startswith("socket:") and port in (None, _port_of(int(name))):
                found.add(target)
    return frozenset(found)


def _port_of(descriptor: int) -> int | None:
    with socket.socket(fileno=os.dup(descriptor)) as end:  # a copy of the descriptor only
        return int(end.getpeername()[1]) if end.family == socket.AF_INET else None


def _send_at_once(descriptor: int) -> bool:
    with contextlib.suppress(OSError):
        if not os.readlink(DESCRIPTORS / str(descriptor)).startswith("socket:"):
            return False
        with socket.socket(fileno=os.dup(descriptor)) as end:  # a copy of the descriptor only
            if end.family not in (socket.AF_INET, socket.AF_INET6):
                return False
            end.getpeername()  # raises for one that only listens
            end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return True
    return False
