"""Writing: Setpoint -> registers, by mailbox, by target and trigger, or not at all.

Independent of reading: it gets the newest sample. A write is confirmed by the samples that follow,
not by the answer to the request.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import (
    ForeignCommandError,
    IneffectiveWriteError,
    LateSetpointError,
    LinkError,
    RobotBusyError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.decode import Sample
from gapbridge.drivers.modbus.registers import Table
from gapbridge.drivers.modbus.schema import (
    Mailbox,
    ProfileFile,
    ReadOnly,
    RegisterWrite,
    TargetTrigger,
)
from gapbridge.drivers.modbus.transport import Transport

Rates = Callable[[], tuple[float, float]]
ANNOUNCE = 0.02  # s between two heartbeats while arming
TARGET_TOLERANCE = 2.0  # counts from the target within which it is reached


def make_writer(
    profile: ProfileFile, transport: Transport, rates: Rates, zero_timeout: float,
    clock: Clock,
) -> MailboxWriter | TargetWriter | ReadOnlyWriter:  # fmt: skip
    """Return the writer of a profile.

    Its ``arm`` moves nothing, and ``look`` reads a sample; its ``write`` gets the sample last read,
    and begins no motion after ``expiry`` (s, monotonic). ``rates`` returns the cell's offset rates,
    m/s and rad/s; ``zero_timeout``: s within which the robot's program must have removed an offset
    of a former owner.
    """
    write = profile.write
    if isinstance(write, Mailbox):
        return MailboxWriter(write, transport, profile.function_23, rates, zero_timeout, clock)
    if isinstance(write, TargetTrigger):
        return TargetWriter(write, transport, clock)
    return ReadOnlyWriter(profile, write, transport)


class ReadOnlyWriter:
    """Refuses to write."""

    def __init__(self, profile: ProfileFile, write: ReadOnly, transport: Transport) -> None:
        self._words = f"{transport.name}: the profile of {profile.name} is read only: "
        self._words += write.because

    def arm(self, state: RobotState, look: Callable[[], Sample]) -> None:
        """Raise WriteError."""
        raise WriteError(self._words)

    def write(self, setpoint: Setpoint, sample: Sample, expiry: float = math.inf) -> None:
        """Raise WriteError."""
        raise WriteError(self._words)

    def pending(self) -> tuple[int, list[int]] | None:
        """Return None."""
        return None

    def release(self) -> None:
        """Do nothing."""

    def target(self) -> Array | None:
        """Return None."""
        return None


class MailboxWriter:
    """Offsets in eleven registers; a program on the robot checks, applies and answers them.

    The cell's rates are sent with them: the program ramps offsets in and out no faster, also when
    nothing is sent any more.
    """

    def __init__(
        self, box: Mailbox, transport: Transport, together: bool, rates: Rates, zero_timeout: float,
        clock: Clock,
    ) -> None:  # fmt: skip
        self._clock, self._now = clock, clock.monotonic
        self._box, self._transport, self._together = box, transport, together
        self._zero_timeout = zero_timeout
        self._cell_rates, self._rates = rates, [0, 0]
        self._units = encode.units_of(box)
        self._armed = False
        self._sequence = self._heartbeat = 0
        self._counts: list[int] = [0] * 6
        self._awaited = 0  # a sequence number that was not echoed yet
        self._sent = 0  # numbers since arming, up to the largest lag of an echo
        self._since = 0.0
        self._pending: tuple[list[int], float] | None = None  # and its expiry, s monotonic

    def arm(self, state: RobotState, look: Callable[[], Sample]) -> None:
        """Send offsets of zero until the robot's program answers them. Raises WriteError.

        First waits until the program has ramped out any former offset.
        """
        try:
            self._rates = encode.rate_counts(self._cell_rates())
        except ValueError as error:
            raise WriteError(f"limits.{error}: what the robot's program can be given") from None
        number = self._wait_for_zero_offset(look)
        # a number that differs from the last one that the program has seen
        self._sequence = (number + encode.SEQUENCES // 4) % (encode.SEQUENCES - 1) + 1
        self._counts = [0] * 6
        until = self._now() + self._box.echo
        while True:
            self._send(self._words())
            answer = look().answer or (0, 0)
            if answer == (self._sequence, encode.RUNNING):
                break
            if self._now() > until:
                raise WriteError(self._silence(*answer))
            self._clock.sleep(ANNOUNCE)
        self._awaited, self._sent, self._armed = 0, 0, True

    def _wait_for_zero_offset(self, look: Callable[[], Sample]) -> int:
        """Wait until a former offset is ramped out; returns the number of the echo.

        Raises WriteError.
        """
        until = self._now() + self._zero_timeout
        while True:
            sample = look()
            number, program = sample.answer or (0, 0)
            if program == encode.ABSENT:  # all zeros is no answer
                raise WriteError(
                    f"{self._transport.name}: {self._box.echo_table} {self._box.echo_address + 1}: "
                    f"found {program}, expected a running mailbox program on the robot "
                    "(docs/porting.md)"
                )
            length = float(np.abs(sample.vectors["echo"]).max())
            if length == 0.0:
                return number
            if self._now() > until:
                raise WriteError(
                    f"{self._transport.name}: the robot's program still applies an offset of "
                    f"{1e3 * length:.3f} mm or mrad, expected none before arming: it takes it out "
                    "by itself, at the rates it was last given"
                )
            self._clock.sleep(ANNOUNCE)

    def write(self, setpoint: Setpoint, sample: Sample, expiry: float = math.inf) -> None:
        """Send one offset, or keep it for the next reading: it leaves before ``expiry`` or never.

        Raises WriteError if the program does not accept them.
        """
        if not self._armed:
            raise WriteError(f"{self._transport.name}: found no mailbox, expected arm() first")
        try:
            counts = encode.offset_counts(self._units, setpoint.offset_in_base.tolist())
        except ValueError as error:
            raise WriteError(f"{self._transport.name}: {error}") from None
        self._check_echo(sample)
        if counts != self._counts:
            self._counts = counts
            self._sequence = encode.next_number(self._sequence)
            self._sent = min(self._sent + 1, encode.SEQUENCES // 4)
            if not self._awaited:
                self._awaited, self._since = self._sequence, self._now()
        words = self._words()
        if self._together:
            self._pending = words, expiry
            return
        try:
            self._transport.write("holding", self._box.address, words)
        except StaleStateError:
            # no retry: its state would be too old. The next cycle sends the offset, and the echo
            # shows whether one has arrived
            self._transport.open()

    def _words(self) -> list[int]:
        self._heartbeat = encode.next_number(self._heartbeat)
        return encode.mailbox_words(self._sequence, self._counts, self._heartbeat, self._rates)

    def _send(self, words: list[int]) -> None:
        """Write a mailbox of zeros; a lost one once more."""
        try:
            self._transport.write("holding", self._box.address, words)
        except StaleStateError:
            self._transport.open()
            self._transport.write("holding", self._box.address, words)

    def _check_echo(self, sample: Sample) -> None:
        """Raise WriteError if an offset is not echoed in time, or the program does not run."""
        number, program = sample.answer or (0, 0)
        if self._awaited:
            ahead = (number - self._awaited) % (encode.SEQUENCES - 1)
            if ahead < encode.SEQUENCES // 2:
                self._awaited = 0
        late = self._awaited and self._now() - self._since > self._box.echo
        if program != encode.RUNNING:
            self._armed = False
            raise WriteError(self._silence(number, program))
        if (self._sequence - number) % (encode.SEQUENCES - 1) > self._sent:
            raise ForeignCommandError(
                f"{self._transport.name}: found number {number} in the mailbox's echo, which was "
                "not sent from here: somebody else writes the mailbox"
            )
        if late:  # it was sent again in every cycle since
            raise IneffectiveWriteError(self._silence(number, program))

    def _silence(self, number: int, program: int) -> str:
        states = {0: "absent", 1: "running", 2: "watchdog expired", 3: "checksum rejected"}
        return (
            f"{self._transport.name}: offsets do not arrive: number {self._sequence} was sent, "
            f"{number} came back last, the robot's program says {states.get(program, program)}"
        )

    def pending(self) -> tuple[int, list[int]] | None:
        """Return the registers of an offset that goes out with the next reading."""
        pending, self._pending = self._pending, None
        if pending is None or self._now() > pending[1]:
            return None
        return self._box.address, pending[0]

    def release(self) -> None:
        """Send nothing more: without a heartbeat the program ramps out the offset.

        At the rates it was given; a zero from here would be a step.
        """
        self._armed, pending = False, self.pending()
        if pending is not None and not any(self._counts):
            # the last setpoint of a ramp, which would have been sent with the next reading
            self._transport.write("holding", *pending)

    def target(self) -> Array | None:
        """Return None: the joints are the robot's own."""
        return None


class TargetWriter:
    """Joint targets in registers, and a trigger that starts the motion there."""

    def __init__(self, entry: TargetTrigger, transport: Transport, clock: Clock) -> None:
        self._now = clock.monotonic
        self._entry, self._transport = entry, transport
        self._size = entry.target.resolution
        self._armed = False
        self._may_move = False  # a motion of ours may be under way
        self._sent: dict[int, int] = {}
        self._target: Array | None = None
        self._since = 0.0
        self._has_run = False  # the robot was busy since the last target was sent
        self._result_before = ""  # what `result` said then; empty: nothing bad

    def arm(self, state: RobotState, look: Callable[[], Sample]) -> None:
        """Write speed and the like, once; no target, no trigger. Raises WriteError."""
        self._write_all(self._entry.before)
        self._armed, self._may_move, self._sent, self._target = True, True, {}, None

    def write(self, setpoint: Setpoint, sample: Sample, expiry: float = math.inf) -> None:
        """Send one target and trigger it. Raises WriteError.

        Raises RobotBusyError, and sends nothing, while the robot is on its way to the last target;
        LateSetpointError, and triggers nothing, if writing the target took too long.
        """
        if not self._armed:
            raise WriteError(f"{self._transport.name}: found no permission, expected arm() first")
        self._check(sample)
        entry = self._entry.target
        try:
            registers = encode.vector_registers(entry, setpoint.q.tolist())
        except ValueError as error:
            raise WriteError(f"{self._transport.name}: target: {error}") from None
        if "busy" in dict(sample.motion) or (
            registers == self._sent and self._off_target(sample).any()
        ):
            raise RobotBusyError(f"{self._transport.name}: the robot moves to the last target")
        if registers == self._sent:
            return
        for first, words in encode.runs(registers):
            self._transport.write(entry.table, first, words, single=self._entry.single)
        self._write_all(self._entry.trigger, expiry)
        self._sent, self._since = registers, self._now()
        self._has_run, self._result_before = False, dict(sample.motion).get("result", "")
        self._target = np.round(setpoint.q / self._size) * self._size

    def _check(self, sample: Sample) -> None:
        """Raise WriteError if the last target was refused, or is not reached in time.

        While the robot is busy, and until it is, the result may be that of the command before.
        """
        motion = dict(sample.motion)
        self._has_run |= "busy" in motion
        words = motion.get("result", "")
        is_ours = "busy" not in motion and (self._has_run or words != self._result_before)
        if words and is_ours and self._target is not None:
            self._armed = False
            raise WriteError(f"{self._transport.name}: the last target failed: {words}")
        if self._target is None or self._now() - self._since < self._entry.following:
            return
        away = self._off_target(sample)
        if away.any():
            joint = int(np.argmax(away))
            self._armed = False
            raise WriteError(
                f"{self._transport.name}: targets have no effect: joint {joint + 1} is "
                f"{away[joint]:.4f} rad from where it was sent {self._entry.following:g} s ago"
            )

    def _off_target(self, sample: Sample) -> Array:
        """Return how far each joint is from the last target (n,), rad; 0: it has reached it."""
        assert self._target is not None
        away = np.abs(sample.vectors["position"] - self._target)
        return np.where(away > TARGET_TOLERANCE * abs(self._size) + 2e-3, away, 0.0)

    def _write_all(self, writes: list[RegisterWrite], expiry: float = math.inf) -> None:
        """Send writes one by one. Raises LateSetpointError before one that would be too late."""
        for write in writes:
            if self._now() > expiry:
                raise LateSetpointError(f"{self._transport.name}: a target took too long to write")
            table: Table = write.table
            words = [int(write.value)] if table == "coil" else write.coding.encode([write.value])
            self._transport.write(table, write.address, words, single=self._entry.single)

    def pending(self) -> tuple[int, list[int]] | None:
        """Return None: a target and its trigger are requests of their own."""
        return None

    def release(self) -> None:
        """Stop the motion where the controller can; else it ends at the last target.

        Also after a target that failed, and once more where the link had been closed by a lost
        answer, or loses this one.
        """
        if not self._may_move:
            return
        self._armed = self._may_move = False
        try:
            self._write_all(self._entry.stop)
        except LinkError:
            self._transport.open()
            self._write_all(self._entry.stop)

    def target(self) -> Array | None:
        """Return the joints sent last, as the registers hold them."""
        return self._target
