"""The checker finds what it is there for: writes that are wrong in one way each."""

from __future__ import annotations

import math
import socket
import struct
import time
from dataclasses import replace

import pytest

from benchmarks.faults.arrival import note_arrivals, receive
from benchmarks.faults.invariants import Bounds, Checker
from benchmarks.faults.wire.modbus import ModbusDecoder
from benchmarks.faults.wire.rtde import RtdeDecoder
from benchmarks.faults.wire.seen import Fresh, Write
from benchmarks.faults.wire.socketcand import PiperDecoder
from gapbridge.drivers.simulated.plant.kinematics import frame_of
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.ur.settings import START_Q

CYCLE = 0.008
BOUNDS = Bounds(
    plant_arm("ur10e"), frame_of((0.0, 0.0, 0.18, 0.0, 0.0, 0.0)), offset=0.002, rotation=0.01,
    offset_rate=0.008, rotation_rate=0.08, cycle=CYCLE,
)  # fmt: skip
STEP = BOUNDS.offset_rate * CYCLE


def stream(checker: Checker, count: int, step: float = STEP, begin: int = 0) -> None:
    """Write offsets along x, each a step farther, each behind a state of its own."""
    for i in range(begin, begin + count):
        state(checker, i)
        write(checker, i, (i + 1 - begin) * step)


def state(checker: Checker, i: int, safe: bool = True, supervisor: int = 3) -> None:
    time = i * CYCLE
    checker.take([Fresh(time, 100.0 + time, START_Q, START_Q, safe, True, supervisor)])


def write(checker: Checker, i: int, x: float, supervisor: int = 3, late: float = 0.001) -> None:
    values = (x, 0.0, 0.0, 0.0, 0.0, 0.0)
    checker.take([Write(i * CYCLE + late, "offset", values, "registers", supervisor)])


def violations(checker: Checker) -> str:
    return "; ".join(words.split(" [")[0] for words in checker.found.violations)


@pytest.fixture
def checker() -> Checker:
    found = Checker(BOUNDS)
    stream(found, 20)
    assert not found.found.violations
    assert found.found.largest_step == pytest.approx(STEP)
    return found


def test_an_offset_beyond_the_envelope_is_found() -> None:
    checker = Checker(BOUNDS)
    stream(checker, 33)
    assert "allowed 2" in violations(checker)


def test_a_jump_is_found(checker: Checker) -> None:
    state(checker, 20)
    write(checker, 20, 20 * STEP + 6 * STEP)
    assert "at once" in violations(checker)


def test_steps_that_are_each_allowed_but_too_many_for_their_time_are_found(
    checker: Checker,
) -> None:
    for i in range(4):
        state(checker, 20 + i)
        write(checker, 20 + i, 20 * STEP - 4 * STEP * (i + 1))
    assert "within" in violations(checker)


def test_a_stream_that_begins_with_a_jump_is_found() -> None:
    checker = Checker(BOUNDS)
    state(checker, 0)
    write(checker, 0, 10 * STEP)
    assert "at once" in violations(checker)


def test_a_write_in_a_state_that_forbids_it_is_found(checker: Checker) -> None:
    for i in range(20, 30):
        state(checker, i, supervisor=5)
    write(checker, 30, 20 * STEP, supervisor=5)
    checker.settle([(0.0, 20 * CYCLE)])
    assert "write in state 5" in violations(checker)


def test_a_write_that_was_only_seen_late_is_judged_by_when_it_arrived(checker: Checker) -> None:
    state(checker, 28, supervisor=5)  # the tap slept; what came before it is reported after it
    late = Write(20 * CYCLE, "offset", (21 * STEP, *[0.0] * 5), "registers", 5)
    checker.take([late])
    checker.settle([(0.0, 20 * CYCLE + 0.001)])
    assert not checker.found.violations
    checker.take([late._replace(time=22 * CYCLE)])
    checker.settle([(0.0, 20 * CYCLE + 0.001)])
    assert "write in state 5" in violations(checker)


def test_a_write_behind_an_old_state_is_found(checker: Checker) -> None:
    write(checker, 20, 20 * STEP, late=0.05)
    assert "after the last fresh state" in violations(checker)


def test_a_zero_is_a_step_as_any_other(checker: Checker) -> None:
    state(checker, 20)
    write(checker, 20, 0.0)
    assert "at once" in violations(checker)


@pytest.mark.parametrize("supervisor", [1, 2, 5])
def test_a_zero_that_drops_an_offset_is_found_in_whatever_state(
    checker: Checker, supervisor: int
) -> None:
    """What letting go did once: 20 steps' worth at once, after the writing had ended."""
    for i in range(20, 30):
        state(checker, i, supervisor=supervisor)
    write(checker, 30, 0.0, supervisor=supervisor)
    assert "at once" in violations(checker)


def test_a_zero_is_no_step_where_the_robots_program_has_withdrawn_the_offset() -> None:
    bounds = replace(BOUNDS, withdraws=0.2)
    needed = 0.2 + 20 * STEP / bounds.offset_rate / 0.98
    for late, fine in ((needed + CYCLE, True), (0.5 * needed, False)):
        checker = Checker(bounds)
        stream(checker, 20)
        i = 20 + round(late / CYCLE)
        for k in range(20, i + 1):
            state(checker, k, supervisor=1 if k < i else 2)
        write(checker, i, 0.0, supervisor=2)
        assert bool(checker.found.violations) != fine, late


def test_joints_that_begin_where_a_fault_left_them_count_from_where_they_began_before() -> None:
    """Three streams of 1 mm each, with an envelope of 2 mm: no new beginning makes a new zero."""
    checker = Checker(BOUNDS)
    q, i = list(START_Q), 0
    for _ in range(3):
        for _ in range(60):
            i += 1
            state(checker, i)
            q[0] += 2.2e-5  # 0.7 m from the first joint's axis: 16 um
            checker.take([Write(i * CYCLE + 0.001, "joints", tuple(q), "servoJ", 3)])
        for _ in range(10):  # a fault
            i += 1
            state(checker, i, supervisor=5)
    assert "allowed 2" in violations(checker)


def test_many_writes_behind_one_state_are_found(checker: Checker) -> None:
    for i in range(6):
        write(checker, 20, 20 * STEP, late=0.001 * i)
    assert "more writes than states" in violations(checker)


def test_a_write_to_a_robot_that_must_not_move_is_found(checker: Checker) -> None:
    for i in range(20, 27):
        state(checker, i, safe=False)
        write(checker, i, 20 * STEP)
    assert "must not move" in violations(checker)


def test_a_write_that_is_no_number_is_found(checker: Checker) -> None:
    write(checker, 20, math.nan)
    assert "nan" in violations(checker)


def test_joints_are_judged_by_where_they_bring_the_tcp() -> None:
    checker = Checker(BOUNDS)
    state(checker, 0)
    checker.take([Write(0.001, "joints", START_Q, "servoJ", 3)])
    assert not checker.found.violations
    state(checker, 1)
    q = (START_Q[0] + 0.005, *START_Q[1:])  # 0.7 m from the first joint's axis: 3 mm
    checker.take([Write(CYCLE, "joints", q, "servoJ", 3)])
    assert checker.found.largest_step == pytest.approx(0.005 * 0.72, rel=0.2)
    assert "at once" in violations(checker)


def test_joints_beyond_their_limits_are_found() -> None:
    checker = Checker(BOUNDS)
    q = (7.0, *START_Q[1:])
    checker.take([Fresh(0.0, 0.0, q, q, True, True, 3), Write(0.001, "joints", q, "servoJ", 3)])
    assert "joint 1" in violations(checker)


def mailbox(words: list[int], address: int = 234) -> bytes:
    body = struct.pack(">BBHHB", 1, 16, address, len(words), 2 * len(words))
    body += struct.pack(f">{len(words)}H", *words)
    return struct.pack(">HHH", 1, 0, len(body)) + body


def test_a_mailbox_is_read_with_its_checksum_and_nothing_else_may_be_written() -> None:
    decoder = ModbusDecoder()
    words = [5, 100, 0xFFFF, 0, 0, 0, 0, 9, 400, 800]
    words.append((18242 + sum(k * w for k, w in enumerate(words, 1))) % 65521)
    (fine,) = decoder.feed(0.0, 1, "modbus", True, mailbox(words), 3)
    assert isinstance(fine, Write)
    assert (fine.kind, fine.values[:2]) == ("offset", (pytest.approx(1e-4), pytest.approx(-1e-6)))
    words[1] += 1
    assert decoder.feed(0.0, 1, "modbus", True, mailbox(words), 3)[0].kind == "broken"  # type: ignore[union-attr]
    (other,) = decoder.feed(0.0, 1, "modbus", True, mailbox(words, 128), 3)
    assert isinstance(other, Write)
    assert other.kind == "forbidden"


def test_a_frame_that_a_daemon_may_not_send_is_forbidden() -> None:
    decoder = PiperDecoder()
    (found,) = decoder.feed(0.0, 1, "can", True, b"< send 152 1 01 >", 3)
    assert isinstance(found, Write)
    assert found.kind == "forbidden"


def test_a_motion_command_of_the_library_other_than_servoj_is_forbidden() -> None:
    decoder = RtdeDecoder(servoj=True)
    names = b"input_int_register_0,input_double_register_0"
    decoder.feed(0.0, 1, "rtde", True, struct.pack(">HB", 3 + len(names), 73) + names, 3)
    reply = b"\x01INT32,DOUBLE"
    decoder.feed(0.0, 1, "rtde", False, struct.pack(">HB", 3 + len(reply), 73) + reply, 3)
    data = b"\x01" + struct.pack(">id", 1, 0.0)  # moveJ
    (found,) = decoder.feed(0.0, 1, "rtde", True, struct.pack(">HB", 3 + len(data), 85) + data, 3)
    assert isinstance(found, Write)
    assert found.kind == "forbidden"


def test_the_kernel_reports_when_bytes_arrived_however_late_they_are_read() -> None:
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
        server.accept()[0] as end,
    ):
        note_arrivals(end)
        for _ in range(50):  # the system takes a moment until it notes times
            before = time.monotonic()
            client.sendall(b"setpoint")
            after = time.monotonic()
            time.sleep(0.05)
            data, arrived = receive(end)
            assert data == b"setpoint"
            if arrived < after + 0.02:
                break
    assert before - 1e-3 < arrived < after + 0.02
