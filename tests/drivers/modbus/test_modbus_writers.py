"""What the writers make of a robot's answers, in a time of the test's own and without a wire."""

from __future__ import annotations

import contextlib
import types
from typing import Any

import numpy as np
import pytest

from gapbridge.core.errors import (
    ForeignCommandError,
    IneffectiveWriteError,
    LateSetpointError,
    LinkError,
    RobotBusyError,
    StaleStateError,
    WriteError,
)
from gapbridge.core.state import Setpoint
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.decode import Sample
from gapbridge.drivers.modbus.profile import read_profile
from gapbridge.drivers.modbus.schema import Turns
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.write import MailboxWriter, TargetWriter, make_writer
from gapbridge.drivers.simulated.modbus.programs import TargetProgram

NOTHING = np.zeros(6)


class ByHand:
    """A clock that goes on where it is set to, and where somebody sleeps."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class Wire:
    """What a writer writes, and a mailbox program that answers what it is set to."""

    name = "the test's wire"

    def __init__(self) -> None:
        self.written: list[tuple[str, int, list[int]]] = []
        self.number = 7  # the last one that the robot's program has applied
        self.lost = 0  # answers still to be lost, each of which closes the link
        self.is_open = True

    def open(self) -> None:
        self.is_open = True

    def write(self, table: str, address: int, words: list[int], single: bool = False) -> None:
        if not self.is_open:
            raise LinkError("found no connection")
        self.written.append((table, address, list(words)))
        if self.lost:
            self.lost -= 1
            self.is_open = False
            raise StaleStateError("no answer")

    def sample(
        self, says: int = encode.RUNNING, *, busy: bool = False, q: Any = NOTHING,
        applied: Any = NOTHING,
    ) -> Sample:  # fmt: skip
        motion = (("busy", "moving"),) if busy else ()
        return Sample({"echo": applied, "position": q}, None, (), motion, (self.number, says))


def made(name: str, together: bool = False) -> tuple[Any, Wire, ByHand]:
    """Return the writer of a shipped profile, its wire and its clock."""
    wire, clock = Wire(), ByHand()
    profile = read_profile(ModbusSettings.shipped / f"{name}.yaml")
    profile = profile.model_copy(update={"function_23": together})
    writer = make_writer(profile, wire, lambda: (0.01, 0.02), 1.0, clock)  # type: ignore[arg-type]
    return writer, wire, clock


def opened(name: str, together: bool = False) -> tuple[Any, Wire, ByHand]:
    """Return the armed writer of a shipped profile, its wire and its clock.

    ``together``: it writes with the next reading.
    """
    writer, wire, clock = made(name, together)

    def look() -> Sample:
        if isinstance(writer, MailboxWriter) and wire.written:
            wire.number = writer._sequence
        return wire.sample()

    writer.arm(types.SimpleNamespace(), look)
    return writer, wire, clock


def offset(x: float) -> Setpoint:
    return Setpoint(NOTHING, NOTHING, np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_an_offset_that_does_not_come_back_ends_the_writing_in_time() -> None:
    writer, wire, clock = opened("ur")
    writer.write(offset(1e-4), wire.sample())
    begun, allowed = clock.now, writer._box.echo
    reason: list[IneffectiveWriteError] = []
    while not reason and clock.now < begun + 2 * allowed:
        clock.now += 0.01
        try:
            writer.write(offset(1e-4), wire.sample())  # the number before it, still
        except IneffectiveWriteError as error:
            reason.append(error)
    assert reason
    assert "offsets do not arrive" in str(reason[0])
    assert allowed < clock.now - begun < allowed + 0.02


@pytest.mark.parametrize("late", [False, True])
def test_an_offset_that_waits_for_the_next_reading_never_leaves_after_its_expiry(
    late: bool,
) -> None:
    writer, wire, clock = opened("ur", together=True)
    before = len(wire.written)
    for x in (1e-4, 0.0):  # the last one of a ramp would leave with the release
        writer.write(offset(x), wire.sample(), clock.now + 0.02)
        clock.now += 0.03 if late else 0.01
        if x:
            assert (writer.pending() is None) == late
            assert writer.pending() is None  # once
    writer.release()
    assert len(wire.written) == before + (not late)


def test_offsets_that_come_back_late_but_in_time_go_on() -> None:
    writer, wire, clock = opened("ur")
    sent, before = [wire.number] * 3, len(wire.written)
    for k in range(400):
        writer.write(offset(1e-6 * k), wire.sample())
        sent.append(writer._sequence)
        clock.now += 0.01
        wire.number = sent[-3]  # two cycles behind
    assert len(wire.written) == before + 400  # 4 s, far beyond what one echo may take
    assert len(set(sent)) == 400
    assert clock.now > 100.0 + 3 * writer._box.echo


@pytest.mark.parametrize("ahead", [1, 5, 1000])
def test_a_number_that_was_not_sent_from_here_is_another_writers(ahead: int) -> None:
    writer, wire, _ = opened("ur")
    writer.write(offset(1e-4), wire.sample())
    wire.number = (writer._sequence - 1 + ahead) % (encode.SEQUENCES - 1) + 1
    with pytest.raises(ForeignCommandError, match="somebody else writes the mailbox"):
        writer.write(offset(2e-4), wire.sample())


@pytest.mark.parametrize("says", [encode.ABSENT, encode.EXPIRED])
def test_a_program_that_does_not_run_ends_the_writing(says: int) -> None:
    writer, wire, _ = opened("ur")
    with pytest.raises(WriteError, match="offsets do not arrive"):
        writer.write(offset(1e-4), wire.sample(says))
    with pytest.raises(WriteError, match="expected arm"):
        writer.write(offset(1e-4), wire.sample())


def test_a_target_waits_while_the_robot_is_busy_and_the_newest_goes_out_after() -> None:
    profiles = [p.stem for p in sorted(ModbusSettings.shipped.glob("*.yaml"))
                if read_profile(p).write.mode == "target_trigger"]  # fmt: skip
    assert profiles
    for name in profiles:
        writer, wire, _ = opened(name)
        assert isinstance(writer, TargetWriter)
        before = len(wire.written)
        for k in range(3):
            q = np.full(6, 0.01 * (k + 1))
            with pytest.raises(RobotBusyError):
                writer.write(Setpoint(q, q, NOTHING), wire.sample(busy=True, q=q))
        assert len(wire.written) == before, name
        writer.write(Setpoint(q, q, NOTHING), wire.sample(q=NOTHING))
        after = len(wire.written)
        assert after > before
        with pytest.raises(RobotBusyError):  # on its way, though it does not say so yet
            writer.write(Setpoint(q, q, NOTHING), wire.sample(q=NOTHING))
        writer.write(Setpoint(q, q, NOTHING), wire.sample(q=q))
        assert len(wire.written) == after
        np.testing.assert_allclose(writer.target(), q, atol=abs(writer._size))


def test_an_offset_goes_out_in_counts_with_the_cells_rates() -> None:
    writer, wire, _ = opened("ur")
    length, angle = writer._box.length_count, writer._box.angle_count
    counts = [1, -2, 300, 4, -5, 6]
    in_base = np.array(counts) * np.repeat([length, angle], 3)
    writer.write(Setpoint(NOTHING, NOTHING, in_base), wire.sample())
    table, address, words = wire.written[-1]
    assert (table, address) == ("holding", writer._box.address)
    assert words[0] == writer._sequence
    assert words[1:7] == [c % 0x10000 for c in counts]
    assert words[8:10] == [500, 200]  # 0.01 m/s and 0.02 rad/s
    assert words[10] == encode.checksum(words[:10])


def test_every_writing_has_another_heartbeat_and_the_same_offset_the_same_number() -> None:
    """Else the robot's program takes a constant offset for a dead client, and ramps it out."""
    writer, wire, _ = opened("ur")
    for _ in range(5):
        writer.write(offset(1e-4), wire.sample())
    words = [words for _, _, words in wire.written[-5:]]
    assert len({w[7] for w in words}) == 5
    assert len({w[0] for w in words}) == 1


def test_letting_go_of_an_offset_writes_nothing() -> None:
    """The robot's program ramps it out by itself; a zero would be a step."""
    writer, wire, _ = opened("ur")
    writer.write(offset(1e-4), wire.sample())
    before = len(wire.written)
    writer.release()
    assert len(wire.written) == before


@pytest.mark.parametrize("ends", [True, False])
def test_arming_waits_for_a_former_offset_to_ramp_out(ends: bool) -> None:
    writer, wire, clock = made("ur")
    applied = np.array([0.0, 0.0, 1e-3, 0.0, 0.0, 0.0])

    def look() -> Sample:
        if wire.written:
            assert not applied.any()
            wire.number = writer._sequence
        if ends:
            applied[2] = max(applied[2] - 1e-4, 0.0)
        return wire.sample(applied=applied)

    if ends:
        writer.arm(types.SimpleNamespace(), look)
        return
    with pytest.raises(WriteError, match=r"still applies an offset of 1\.000 mm"):
        writer.arm(types.SimpleNamespace(), look)
    assert not wire.written
    assert 1.0 < clock.now - 100.0 < 1.1


def test_the_echo_of_a_former_session_does_not_arm() -> None:
    writer, wire, clock = made("ur")
    with pytest.raises(WriteError, match="offsets do not arrive"):
        writer.arm(types.SimpleNamespace(), wire.sample)
    assert writer._box.echo < clock.now - 100.0 < writer._box.echo + 0.1


def target_writer() -> tuple[TargetWriter, Wire, ByHand]:
    for path in sorted(ModbusSettings.shipped.glob("*.yaml")):
        if read_profile(path).write.mode == "target_trigger":
            return opened(path.stem)
    raise AssertionError("no profile sends targets")


def test_a_target_is_there_before_it_is_triggered() -> None:
    writer, wire, _ = target_writer()
    wire.written.clear()
    q = np.full(6, 0.1)
    writer.write(Setpoint(q, q, NOTHING), wire.sample())
    trigger = [(write.table, write.address) for write in writer._entry.trigger]
    assert [(table, at) for table, at, _ in wire.written][-len(trigger) :] == trigger
    assert len(wire.written) > len(trigger)


def test_a_target_that_took_too_long_to_write_is_not_triggered() -> None:
    writer, wire, clock = target_writer()
    q = np.full(6, 0.1)
    triggers = {(write.table, write.address) for write in writer._entry.trigger}
    wire.written.clear()
    with pytest.raises(LateSetpointError):
        writer.write(Setpoint(q, q, NOTHING), wire.sample(), expiry=clock.now - 1e-3)
    assert not triggers & {(table, at) for table, at, _ in wire.written}
    written = len(wire.written)
    assert written  # the target, which moves nothing
    writer.write(Setpoint(q, q, NOTHING), wire.sample(), expiry=clock.now + 1e-3)
    assert triggers <= {(table, at) for table, at, _ in wire.written[written:]}


def test_a_trigger_that_took_too_long_itself_is_not_completed() -> None:
    """An igus coil is reset and set: seed 77552 stood still in between."""
    writer, wire, clock = target_writer()
    trigger = [(write.table, write.address) for write in writer._entry.trigger]
    assert len(trigger) == 2
    write = writer._transport.write

    def slow(*given: Any, **named: Any) -> None:
        write(*given, **named)
        if given[:2] == trigger[0]:
            clock.now += 0.5

    writer._transport.write = slow  # type: ignore[method-assign]
    wire.written.clear()
    q = np.full(6, 0.1)
    with pytest.raises(LateSetpointError):
        writer.write(Setpoint(q, q, NOTHING), wire.sample(), expiry=clock.now + 0.1)
    assert [(table, at) for table, at, _ in wire.written].count(trigger[1]) == 1


def test_a_target_that_is_not_reached_in_time_ends_the_writing() -> None:
    writer, wire, clock = target_writer()
    q = np.full(6, 0.1)
    writer.write(Setpoint(q, q, NOTHING), wire.sample())
    begun, following = clock.now, writer._entry.following
    while clock.now - begun < following - 0.05:
        clock.now += 0.02
        with pytest.raises(RobotBusyError):
            writer.write(Setpoint(q, q, NOTHING), wire.sample(q=0.5 * q))
    clock.now += 0.1
    with pytest.raises(WriteError, match="targets have no effect: joint 1 is 0\\.05"):
        writer.write(Setpoint(q, q, NOTHING), wire.sample(q=0.5 * q))


def test_a_target_that_the_robot_refused_ends_the_writing() -> None:
    writer, wire, _ = target_writer()
    q = np.full(6, 0.1)
    writer.write(Setpoint(q, q, NOTHING), wire.sample())
    refused = wire.sample(q=q)._replace(motion=(("result", "out of reach"),))
    with pytest.raises(WriteError, match="the last target failed: out of reach"):
        writer.write(Setpoint(q, q, NOTHING), refused)


def test_the_result_of_the_command_before_is_not_taken_for_ours() -> None:
    writer, wire, _clock = target_writer()
    before = ("result", "last command: found 3, expected 0 or 1")
    q = np.zeros(6)
    setpoint = Setpoint(q + 0.01, q, np.zeros(6))
    for motion in ((before,), (before,), (("busy", "runs"), before)):
        sample = wire.sample(q=q)._replace(motion=motion)
        with contextlib.suppress(RobotBusyError):
            writer.write(setpoint, sample)
    done = wire.sample(q=q + 0.01)._replace(motion=(before,))
    with pytest.raises(WriteError, match="the last target failed: last command: found 3"):
        writer.write(setpoint, done)  # ours ran, and this is what it came to


def test_a_target_that_failed_is_stopped_all_the_same() -> None:
    """A robot that is too slow is still on its way when the writing ends."""
    writer, wire, clock = opened("niryo")
    stop = [(write.table, write.address, [int(write.value)]) for write in writer._entry.stop]
    assert stop
    q = np.full(6, 0.1)
    for failed in ("slow", "refused"):
        writer.arm(types.SimpleNamespace(), wire.sample)
        writer.write(Setpoint(q, q, NOTHING), wire.sample())
        sample = wire.sample(q=0.5 * q)
        if failed == "refused":
            sample = sample._replace(motion=(("result", "aborted"),))
        clock.now += writer._entry.following + 0.1
        with pytest.raises(WriteError):
            writer.write(Setpoint(q, q, NOTHING), sample)
        wire.written.clear()
        writer.release()
        assert wire.written == stop, failed
        writer.release()  # the robot may be somebody else's by now
        assert wire.written == stop, failed


@pytest.mark.parametrize("lost", ["target", "stop"])
def test_a_lost_answer_does_not_keep_the_stop_from_a_robot_that_moves(lost: str) -> None:
    writer, wire, _ = opened("niryo")
    stop = [(write.table, write.address, [int(write.value)]) for write in writer._entry.stop]
    q = np.full(6, 0.1)
    writer.write(Setpoint(q, q, NOTHING), wire.sample())
    wire.lost = 1
    if lost == "target":
        with pytest.raises(StaleStateError):
            writer.write(Setpoint(0.5 * q, q, NOTHING), wire.sample(q=q))
    writer.release()
    assert wire.written[-1:] == stop
    assert wire.is_open


@pytest.mark.parametrize("kind", ["f32", "f64", "i32"])
def test_a_target_in_floats_is_no_whole_number_of_degrees(kind: str) -> None:
    profile = read_profile(ModbusSettings.shipped / "igus.yaml")
    scale = {"scale": 0.01 if kind == "i32" else 1.0, "type": kind}
    target = profile.write.target.model_copy(update=scale)  # type: ignore[union-attr]
    write = profile.write.model_copy(update={"target": target})
    wire = Wire()
    writer = make_writer(
        profile.model_copy(update={"write": write}), wire, lambda: (0.01, 0.02), 1.0, ByHand()
    )  # type: ignore[arg-type]
    writer.arm(types.SimpleNamespace(), wire.sample)  # type: ignore[arg-type]
    q = np.full(6, 0.1)
    writer.write(Setpoint(q, q, NOTHING), wire.sample())
    reported = writer.target()
    assert reported is not None
    np.testing.assert_allclose(reported, q, atol=1e-4)
    with pytest.raises(RobotBusyError):  # 5 mrad away: on its way
        writer.write(Setpoint(q, q, NOTHING), wire.sample(q=q - 5e-3))


def test_the_simulated_robot_reads_the_turns_of_a_target() -> None:
    profile = read_profile(ModbusSettings.shipped / "igus.yaml")
    entry = profile.write.target.model_copy(  # type: ignore[union-attr]
        update={"type": "u16", "scale": 1.0, "unit": "mrad", "turns": Turns(address=160)}
    )
    write = profile.write.model_copy(update={"target": entry})
    q = [-0.5, 7.0, 1.0, 2.0, 3.0, -4.0]
    registers = encode.vector_registers(entry, q)
    goals: list[Any] = []
    controller: Any = types.SimpleNamespace(move_own=goals.append)
    program = TargetProgram(profile.model_copy(update={"write": write}), write)
    for one in write.trigger:
        program.wrote(controller, one.table, one.address, [int(one.value)])
    program.cycle(controller, lambda _, first, count: [registers[first + k] for k in range(count)])
    np.testing.assert_allclose(goals, [q], atol=1e-3)
