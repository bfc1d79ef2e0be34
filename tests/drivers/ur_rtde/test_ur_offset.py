"""Offset mode: the shipped program on the robot, offsets through registers, nominal joints back."""

from __future__ import annotations

import re
from textwrap import dedent

import numpy as np
import pytest
from driver_runs import Bench, offset_program, run_driver
from simulated_controller import SimulatedController

from gapbridge.core.errors import WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import Clock
from gapbridge.drivers.ur_rtde import registers
from gapbridge.drivers.ur_rtde.command import OffsetWriter
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

OFFSET = [1.0e-3, -5.0e-4, 2.0e-3, 1.0e-3, -4.0e-4, -2.0e-3]
ARMED = """
driver.connect()
state = read_for(20)
driver.arm(state)
nominal = driver.nominal_q(state).copy()
sent = np.zeros(6)
def write(state, offset):
    sent[:] += np.clip(np.array(offset) - sent, -1e-4, 1e-4)
    driver.write_setpoint(setpoint(state, nominal, nominal, sent.copy()))
def stream(cycles, offset):
    for _ in range(cycles):
        state = driver.read_state()
        write(state, offset)
    return state
"""


def run(host: str, body: str, **link: object) -> dict[str, object]:
    return run_driver(host, ARMED + dedent(body), mode="offset", **link)


@pytest.mark.slow
def test_an_offset_moves_the_tcp_and_is_taken_out_of_the_nominal_joints(
    offset_robot: SimulatedController, bench: Bench
) -> None:
    before = bench.truth()["rigid_tcp"]
    out = run(
        offset_robot.host,
        f"""
        driver.nominal_q(stream(5, {OFFSET}))  # what is compiled is compiled now
        state = stream(150, {OFFSET})
        out["truth"] = bench.truth()["rigid_tcp"]
        out["applied"] = driver.reader.applied.tolist()
        out["echo"] = driver.reader.echo - driver._writer._sequence
        out["program"] = driver.reader.program
        out["nominal"] = (driver.nominal_q(state) - nominal).tolist()
        out["moved"] = float(np.abs(state.target_q - nominal).max())
        driver.release()
        state = read_for(150)
        out["released"] = driver.reader.applied.tolist()
        out["back"] = (state.target_q - nominal).tolist()
        """,
    )
    assert out["applied"] == pytest.approx(OFFSET, abs=1e-9)
    assert -4 <= out["echo"] <= 0  # type: ignore[operator]
    assert out["program"] == registers.Program.RUNNING
    assert out["nominal"] == pytest.approx([0] * 6, abs=1e-8)
    assert out["moved"] > 5e-4  # type: ignore[operator]
    moved = [a - b for a, b in zip(out["truth"][:3], before[:3], strict=True)]  # type: ignore[index]
    assert moved == pytest.approx(OFFSET[:3], abs=1e-5)
    assert out["released"] == pytest.approx([0] * 6, abs=1e-12)
    assert out["back"] == pytest.approx([0] * 6, abs=1e-9)


@pytest.mark.realtime
def test_the_nominal_joints_are_the_robots_own_while_it_moves(
    offset_robot: SimulatedController,
) -> None:
    out = run(
        offset_robot.host,
        f"""
        stream(100, {OFFSET})
        goal = nominal + [0.2, 0.1, -0.1, 0.05, 0.1, -0.2]
        bench.do("move " + " ".join(map(str, goal)))
        seen = []
        for _ in range(700):
            state = driver.read_state()
            seen.append(driver.nominal_q(state).copy())
            write(state, {OFFSET})
        way = (np.array(seen) - nominal) / (goal - nominal)
        out["end"] = (seen[-1] - goal).tolist()
        # a straight joint move: all joints are the same share of their way
        out["spread"] = float(np.ptp(way, axis=1).max())
        """,
    )
    assert out["end"] == pytest.approx([0] * 6, abs=1e-7)
    assert out["spread"] < 1e-5  # type: ignore[operator]


@pytest.mark.slow
def test_without_a_heartbeat_the_robots_program_goes_to_zero_and_on(
    offset_robot: SimulatedController,
) -> None:
    out = run(
        offset_robot.host,
        f"""
        stream(100, {OFFSET})
        for _ in range(250):
            state = driver.read_state()
        out["program"] = driver.reader.program
        out["applied"] = driver.reader.applied.tolist()
        out["runtime"] = state.runtime_state
        """,
    )
    assert out["program"] == registers.Program.EXPIRED
    assert out["applied"] == [0] * 6
    assert out["runtime"] == 2


@pytest.mark.realtime
def test_whoever_is_killed_is_withdrawn_at_the_rates_of_the_cell(
    offset_robot: SimulatedController,
) -> None:
    """Slower than the program's own limit: the rates came with the offsets."""
    out = run_driver(
        offset_robot.host,
        """
        from gapbridge.drivers.gate import GateBounds
        driver.gate.set_bounds(GateBounds(offset_rate=0.0005, offset_rotation_rate=0.001))
        driver.connect()
        driver.arm(read_for(20))
        nominal = driver.nominal_q(driver.read_state()).copy()
        for k in range(250):
            state = driver.read_state()
            offset = np.array([9e-7 * k, 0, 0, 1.8e-6 * k, 0, 0])
            driver.write_setpoint(setpoint(state, nominal, nominal, offset))
        driver.release()
        seen = []
        for _ in range(600):
            state = driver.read_state()
            seen.append((state.timestamp, *driver.reader.applied))
        out["seen"] = seen
        before = driver.reader.applied[0]
        driver.arm(state)
        out["armed"] = (before, driver.reader.applied[0])
        """,
        mode="offset",
    )
    rows = np.array(out["seen"])
    assert rows[0, 1] > 1.5e-4
    assert rows[-1, 1] < rows[0, 1]
    early = rows[rows[:, 0] < rows[0, 0] + 0.1, 1]
    assert (np.diff(early) >= 0.0).all()  # no zero was sent: the program waits out the silence
    gaps = np.diff(rows[:, 0])
    assert (-np.diff(rows[:, 1]) <= 0.0005 * gaps * 1.001 + 1e-12).all()
    assert (-np.diff(rows[:, 4]) <= 0.001 * gaps * 1.001 + 1e-12).all()
    assert out["armed"][1] == 0.0


def test_rates_that_are_too_small_to_be_sent_are_refused() -> None:
    assert registers.rates(0.05, 0.1) == 1250 << 16 | 1000
    with pytest.raises(ValueError, match="offset_rate: found 1e-05"):
        registers.rates(1e-5, 0.1)


@pytest.mark.slow
def test_a_program_that_takes_no_rates_is_refused_when_arming(
    offset_robot: SimulatedController,
) -> None:
    out = run_driver(
        offset_robot.host,
        """
        from gapbridge.drivers.ur_rtde import registers
        right, registers.checksum = registers.checksum, lambda u, s, r: right(u, s, r + 1)
        driver.connect()
        out["error"] = error_of(driver.arm, read_for(20))
        """,
        mode="offset",
    )
    assert "gapbridge_offset.script of this version" in out["error"]


def test_a_wrong_checksum_moves_nothing_and_is_reported(offset_robot: SimulatedController) -> None:
    out = run(
        offset_robot.host,
        f"""
        from gapbridge.drivers.ur_rtde import registers
        right, registers.checksum = registers.checksum, lambda *a: right(*a) + 1
        error, count = "", 0
        while not error and count < 400:
            state, count = driver.read_state(), count + 1
            error = error_of(write, state, {OFFSET})
        out["error"] = error
        out["applied"] = driver.reader.applied.tolist()
        """,
    )
    assert "offsets do not arrive" in str(out["error"])
    # the program's last word: on a busy machine it also waits in vain for a right one
    assert re.search("says (REJECTED|EXPIRED)", str(out["error"]))
    assert out["applied"] == [0] * 6


@pytest.mark.slow
def test_a_stopped_program_is_noticed(offset_robot: SimulatedController) -> None:
    out = run(
        offset_robot.host,
        """
        import socket
        stream(50, [1e-3, 0, 0, 0, 0, 0])
        with socket.create_connection((host, 29999)) as dashboard:
            dashboard.recv(100)
            dashboard.sendall(b"stop\\n")
            dashboard.recv(100)
        error, count = "", 0
        while not error and count < 400:
            state, count = driver.read_state(), count + 1
            error = error_of(write, state, [0.0] * 6)
        out["error"] = error
        """,
    )
    assert str(out["error"]).startswith("WriteError: ")


@pytest.mark.slow
def test_arming_needs_the_robots_program(controller: SimulatedController) -> None:
    out = run_driver(
        controller.host,
        """
        driver.connect()
        out["error"] = error_of(driver.arm, read_for(20))
        """,
        mode="offset",
    )
    assert "gapbridge_offset.script" in out["error"]


@pytest.mark.slow
def test_another_tcp_in_the_controller_is_refused(offset_robot: SimulatedController) -> None:
    out = run_driver(
        offset_robot.host,
        """
        tool = np.eye(4)
        tool[2, 3] = 0.18
        other = make_driver(
            UrRtdeSettings(host=host, mode="offset"), Model(builtin_arm("ur10e"), tool)
        )
        other.connect()
        out["error"] = error_of(other.arm, other.read_state())
        """,
    )
    assert "the controller's TCP is 180.0 mm" in out["error"]


def test_the_checksum_is_what_both_sides_compute() -> None:
    from gapbridge.drivers.simulated.ur.programs.offset_program import checksum

    for sequence in (1, 77, registers.LAST_SEQUENCE):
        units = registers.counts(OFFSET)
        assert registers.checksum(units, sequence, 7) == checksum(OFFSET, sequence, 7)
    assert registers.checksum([-5, 0, 0, 0, 0, 0], 0, 0) == 2**31 - 5


def test_sequence_numbers_go_round() -> None:
    assert registers.next_sequence(registers.LAST_SEQUENCE) == 1
    assert registers.next_sequence(1) == 2
    assert registers.reached(5, 5)
    assert registers.reached(3, registers.LAST_SEQUENCE - 2)
    assert not registers.reached(4, 5)


def test_the_shipped_program_is_whole() -> None:
    text = offset_program()
    code = [line.split("#")[0].split() for line in text.splitlines()]
    message = [line[0].rstrip(":") for line in code if line]
    opened = sum(word in ("def", "if", "while", "thread") for word in message)
    assert opened == message.count("end")
    for number in (18, 19, 20, 21, 22):
        assert str(number) in text
    for name in ("path_offset_enable", "path_offset_set(", "path_offset_disable", "sync()"):
        assert name in text
    # one cycle's steps: those of the simulator, and no more than the limiter's rates need
    assert "gb_shift_step_most = 0.0001" in text
    assert "gb_turn_step_most = 0.0002" in text


@pytest.mark.slow
def test_registers_that_another_client_holds_are_refused_in_one_line(
    offset_robot: SimulatedController,
) -> None:
    out = run(
        offset_robot.host,
        """
        other = make_driver(UrRtdeSettings(host=host, mode="offset"), model)
        other.connect()
        state = other.read_state()
        out["unarmed"] = error_of(other.write_setpoint, setpoint(state, nominal, nominal))
        other.release()
        out["error"] = error_of(other.arm, state)
        driver.close()
        driver.close()
        """,
    )
    assert "expected arm() first" in str(out["unarmed"])
    assert str(out["error"]).startswith("WriteError: ")
    assert "in use" in str(out["error"])


def test_the_oldest_offset_that_has_not_come_back_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    class Inputs:
        setInputDoubleRegister = staticmethod(lambda register, value: True)
        setInputIntRegister = staticmethod(
            lambda register, value: sent.update({register: value}) is None
        )

    sent: dict[int, int] = {}
    clock, rates = Clock(), (0.05, 0.1)
    clock.monotonic = lambda: now
    settings = UrRtdeSettings(mode="offset")
    writer = OffsetWriter(settings, lambda: rates, clock)
    monkeypatch.setattr(OffsetWriter, "_open", lambda _: Inputs())
    q, zero = np.zeros(6), np.zeros(6)
    state = RobotState(
        1.0, 1.0, q, zero, q, zero, robot_mode=7, safety_mode=1, runtime_state=2
    )  # fmt: skip

    def answer(number: int) -> None:
        writer.note_answer(number, registers.Program.RUNNING, zero)

    def write() -> int:
        writer.write(Setpoint(q, zero, q), state)
        return sent[registers.SEQUENCE]

    now = 100.0
    answer(0)
    writer.arm(state, lambda: answer(sent[registers.SEQUENCE]))
    assert writer.unanswered_since() == np.inf
    first = write()
    now = 100.002
    second = write()
    assert writer.unanswered_since() == 100.0
    answer(first)
    assert writer.unanswered_since() == 100.002
    writer.keep_alive()
    answer(second)
    assert writer.unanswered_since() == np.inf
    now = 101.0
    writer.keep_alive()
    write()
    now = 101.0 + settings.echo + 0.001
    with pytest.raises(WriteError, match=r"offsets do not arrive: number .*\(sent 0\.101 s ago\)"):
        writer.keep_alive()
    writer.arm(state, lambda: answer(sent[registers.SEQUENCE]))
    writer.keep_alive()
