"""The robot's side of a Modbus link: the mailbox program, and targets that a trigger starts."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.profile import ECHO_WORDS, MAILBOX_WORDS, addresses, turns_of
from gapbridge.drivers.modbus.registers import UNITS, Table
from gapbridge.drivers.modbus.schema import Mailbox, ProfileFile, TargetTrigger, Vector
from gapbridge.drivers.simulated.modbus.image import bad
from gapbridge.drivers.simulated.plant.kinematics import Joints, offset_frame, solve, tcp_in_base
from gapbridge.drivers.simulated.plant.motion import Hold
from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.server.arm_controller import HOLD, ArmController
from gapbridge.drivers.simulated.server.bench import BenchError
from gapbridge.drivers.simulated.ur.programs.offset_program import (
    NOTHING,
    SHIFT_STEP,
    TURN_STEP,
    approach,
)

log = logging.getLogger("drivers.simulated")

Read = Callable[[Table, int, int], list[int]]
"""Table, first address and count -> registers as clients have written them."""


class NoProgram:
    """Nothing is ever applied."""

    def wrote(
        self, controller: ArmController, table: Table, address: int, values: Sequence[int]
    ) -> None:
        """Do nothing."""

    def cycle(self, controller: ArmController, read: Read) -> None:
        """Do nothing."""

    def registers(self, controller: ArmController) -> list[tuple[Table, int, int]]:
        """Return nothing."""
        return []


class MailboxProgram:
    """Checks offsets (sequence, checksum, heartbeat) and adds them to the robot's own motion.

    A checksum that does not fit leaves the offset as it was; a heartbeat that stands still takes
    it out, at the rates that came with the last offset. What stands in the registers when the
    program starts, or after a silence, counts only once the heartbeat has changed: it may be of a
    client that is dead. ``running`` False is a program that was stopped: nothing is applied or
    answered.
    """

    def __init__(self, box: Mailbox) -> None:
        self._box = box
        self.running = True
        self._sequence = 0
        self._heartbeat: int | None = None  # None: not seen yet
        self._alive = False  # the heartbeat has changed, and not stood still since
        self._silent = 0.0  # s
        self._rates = (0.0, 0.0)  # m/s, rad/s
        self._wanted: Vector6 = NOTHING
        self.applied: Vector6 = NOTHING
        self._state = encode.EXPIRED
        self._solved: tuple[Joints, Vector6] | None = None  # inputs of the last joint offsets

    def run(self, running: bool) -> None:
        """Start the program, or stop it."""
        self.running = running

    def wrote(
        self, controller: ArmController, table: Table, address: int, values: Sequence[int]
    ) -> None:
        """Do nothing: the program polls its registers."""

    def cycle(self, controller: ArmController, read: Read) -> None:
        """Read the mailbox, and move the applied offset towards the one wanted."""
        if not controller.can_move:  # a stop ends the program: the arm stays where it is
            self._wanted = self.applied = NOTHING
        elif self.running:
            self._take(read(self._box.table, self._box.address, MAILBOX_WORDS), controller.period)
        else:
            self._wanted, self._alive, self._heartbeat = NOTHING, False, None
        shift, turn = self._rates
        self.applied = approach(
            self.applied, self._wanted,
            (min(shift * controller.period, SHIFT_STEP), min(turn * controller.period, TURN_STEP)),
        )  # fmt: skip
        self._apply(controller)

    def _take(self, words: list[int], dt: float) -> None:
        *body, reported_value = words
        if encode.checksum(body) != reported_value:
            self._state = encode.REJECTED if any(words) else encode.EXPIRED
            self._silent += dt
        else:
            if self._heartbeat is not None and body[7] != self._heartbeat:
                self._alive, self._silent = True, 0.0
            else:
                self._silent += dt
            self._heartbeat = body[7]
            self._state = encode.RUNNING if self._alive else encode.EXPIRED
            if self._alive and body[0] != self._sequence:
                self._sequence = body[0]
                x, y, z, rx, ry, rz = encode.offset_of(self._box, body[1:7])
                self._wanted = (x, y, z, rx, ry, rz)
                shift, turn = (
                    n * unit for n, unit in zip(body[8:], encode.RATE_COUNTS, strict=True)
                )
                self._rates = (shift, turn)
        if self._silent > self._box.watchdog:
            self._state, self._wanted, self._sequence = encode.EXPIRED, NOTHING, 0
            self._alive = False

    def _apply(self, controller: ArmController) -> None:
        if self.applied == NOTHING:
            if any(controller.joint_offset):
                controller.offset_by((0.0,) * controller.n)
            self._solved = None
            return
        if (controller.own_q, self.applied) == self._solved:
            return
        arm, tool = controller.plant.arm, controller.declared.tool
        self._solved = (controller.own_q, self.applied)
        wanted = offset_frame(tcp_in_base(arm, controller.own_q, tool), self.applied)
        near = tuple(a + b for a, b in zip(controller.own_q, controller.joint_offset, strict=True))
        joints = solve(arm, wanted, near, tool, steps=20)
        if joints is None:
            log.warning("no joints for the offset pose")
            controller.protective_stop()
            return
        controller.offset_by([a - b for a, b in zip(joints, controller.own_q, strict=True)])

    def registers(self, controller: ArmController) -> list[tuple[Table, int, int]]:
        """Return the eight registers of the answer."""
        box = self._box
        words = [0] * ECHO_WORDS
        if self.running:
            applied = encode.offset_counts(encode.units_of(box), self.applied)
            words = [self._sequence, self._state, *(count & 0xFFFF for count in applied)]
        return [(box.echo_table, box.echo_address + i, word) for i, word in enumerate(words)]


class TargetProgram:
    """Moves to the joints in the target registers when the trigger has been written."""

    def __init__(self, profile: ProfileFile, entry: TargetTrigger) -> None:
        self._profile, self._entry = profile, entry
        self._step = 0  # orders of the trigger seen so far
        self._due = False
        self._refused = False
        self._done = 0

    def wrote(
        self, controller: ArmController, table: Table, address: int, values: Sequence[int]
    ) -> None:
        """Follow the orders of the trigger, in turn; a stop brakes."""
        trigger, stop = self._entry.trigger, self._entry.stop
        for i, value in enumerate(values):
            order = trigger[self._step]
            if (table, address + i) == (order.table, order.address):
                self._step = self._step + 1 if value == int(order.value) else 0
                if self._step == len(trigger):
                    self._step, self._due = 0, True
            if stop and (table, address + i, value) == (
                stop[-1].table, stop[-1].address, int(stop[-1].value),
            ):  # fmt: skip
                self._due = False
                controller.stop_own()

    def cycle(self, controller: ArmController, read: Read) -> None:
        """Start the motion that was triggered."""
        if not self._due:
            return
        self._due = False
        entry = self._entry.target
        joints = self._numbers(entry, read)
        if entry.turns is not None:
            turns = self._numbers(turns_of(entry, entry.turns), read)
            joints = [angle + turn for angle, turn in zip(joints, turns, strict=True)]
        try:
            controller.move_own(tuple(joints))
            self._refused = False
            self._done += 1
        except BenchError as error:
            log.warning("target refused: %s", error)
            self._refused = True

    def _numbers(self, entry: Vector, read: Read) -> list[float]:
        """Return what clients have written to a vector of joints (n,), rad."""
        size, coding = entry.scale * UNITS[entry.unit][1], entry.coding
        return [
            coding.decode(read(entry.table, address, coding.words))[0] * size
            for address in addresses(entry, self._profile.joints)
        ]

    def registers(self, controller: ArmController) -> list[tuple[Table, int, int]]:
        """Return whether a motion runs, and the result of the last one."""
        moving = not (isinstance(controller.motion, Hold) or controller.motion is HOLD)
        entries: list[tuple[Table, int, int]] = []
        busy, result = self._entry.busy, self._entry.result
        if busy is not None:
            entries.append((busy.table, busy.address, bad(busy) if moving else busy.good[0]))
        if result is not None:
            fine = result.good[-1] if self._done else result.good[0]
            value = bad(result) if self._refused else fine
            entries.append((result.table, result.address, value))
        return entries


def make_program(profile: ProfileFile) -> MailboxProgram | TargetProgram | NoProgram:
    """Return the robot's side of a profile."""
    if isinstance(profile.write, Mailbox):
        return MailboxProgram(profile.write)
    if isinstance(profile.write, TargetTrigger):
        return TargetProgram(profile, profile.write)
    return NoProgram()
