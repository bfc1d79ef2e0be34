"""The Modbus driver where the contract does not go: refusals, the watchdog, wrong maps."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from contract_checks import OFFSET, next_state, setpoint_of, stream
from contract_modbus import INVENTED, ModbusCase
from patience import PATIENCE, wait_for

from gapbridge.bridge.cell import load_cell
from gapbridge.core.errors import LinkError, WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.gate import GateBounds
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.simulated.modbus.programs import MailboxProgram
from gapbridge.drivers.simulated.modbus.server import ModbusServer
from gapbridge.drivers.simulated.server.bench import BenchError


@pytest.fixture
def ur() -> Iterator[ModbusCase]:
    with ModbusCase("ur") as found:
        yield found


def program_of(case: ModbusCase) -> MailboxProgram:
    server = case.servers[0]
    assert isinstance(server, ModbusServer)
    assert isinstance(server.program, MailboxProgram)
    return server.program


def test_the_robot_takes_offsets_out_when_the_heartbeat_stops() -> None:
    with ModbusCase("ur", watchdog=2.0) as ur, ur.driver() as driver:
        driver.arm(next_state(driver))

        def moved() -> bool:
            return max(map(abs, program_of(ur).applied)) > 1e-4

        stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), PATIENCE, moved)
        assert moved()
        driver.transport.close()  # as if the process had died: nothing is released
        wait_for(lambda: not any(program_of(ur).applied), "the watchdog")


def test_a_robot_without_its_program_is_not_armed(ur: ModbusCase) -> None:
    program_of(ur).running = False
    ur.run_cycles()
    with ur.driver() as driver, pytest.raises(WriteError, match="expected a running mailbox progr"):
        driver.arm(next_state(driver))


def test_a_program_that_ends_while_offsets_flow_is_noticed(ur: ModbusCase) -> None:
    with ur.driver() as driver:
        driver.arm(next_state(driver))
        stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), 0.3)
        program_of(ur).running = False
        with pytest.raises(WriteError, match=r"offsets do not arrive.*absent"):
            stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), PATIENCE)


def test_a_mailbox_whose_checksum_is_wrong_is_not_applied(ur: ModbusCase) -> None:
    with ur.driver() as driver:
        next_state(driver)
        words = encode.mailbox_words(5, [400] * 6, 9, [2500, 1000])
        driver.transport.write("holding", 234, [*words[:-1], words[-1] ^ 1])
        ur.run_cycles(25)
        assert not any(program_of(ur).applied)
        # a silence of half a second, since the program's start too, outranks a wrong checksum
        assert driver._look().answer[1] in (encode.REJECTED, encode.EXPIRED)
        for beat in (9, 10):
            words = encode.mailbox_words(5, [400] * 6, beat, [2500, 1000])
            driver.transport.write("holding", 234, words)
            ur.run_cycles(25)
        assert any(program_of(ur).applied)


def test_registers_that_a_dead_client_left_move_nothing(ur: ModbusCase) -> None:
    """A program that starts, or comes back, waits for a heartbeat that changes."""
    with ur.driver() as driver:
        next_state(driver)
        words = encode.mailbox_words(5, [5000] * 3 + [0] * 3, 9, [50000, 10000])
        driver.transport.write("holding", 234, words)
        largest = 0.0
        for running in (True, False, True):
            program_of(ur).running = running
            for _ in range(75):
                ur.run_cycles(1)
                largest = max(largest, *map(abs, program_of(ur).applied))
        assert largest == 0.0
        assert driver._look().answer == (0, encode.EXPIRED)


@pytest.mark.realtime(limit=0.02)
def test_a_client_that_dies_is_withdrawn_at_the_rates_of_its_cell(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rate, turn = 0.002, 0.004  # m/s, rad/s
    with ModbusCase("ur", watchdog=None) as ur, ur.driver() as driver:
        driver.gate.set_bounds(GateBounds(offset_rate=rate, offset_rotation_rate=turn))
        driver.arm(next_state(driver))
        begun = time.monotonic()

        def towards(state: RobotState, q: np.ndarray) -> Setpoint:
            share = min((time.monotonic() - begun) * 0.8 * rate, 1e-3)
            return setpoint_of(state, q, q, (share, 0.0, 0.0, 0.0, 0.0, 0.0))

        stream(driver, towards, 10.0, lambda: program_of(ur).applied[0] > 5e-4)
        largest = program_of(ur).applied[0]
        assert largest > 5e-4
        sent, released = [], time.monotonic()
        with monkeypatch.context() as watched:
            for way in ("write", "exchange"):
                watched.setattr(driver.transport, way, lambda *a: sent.append(a))
            driver.release()
        assert sent == []  # as a kill: no zero from here, which would be a step
        path = [(time.monotonic(), largest)]
        while path[-1][1] > 0.0:
            path.append((time.monotonic(), program_of(ur).applied[0]))
            assert path[-1][0] < released + 10.0
            time.sleep(0.002)
        times, lengths = np.array(path).T
        assert (-np.diff(lengths) <= rate * (np.diff(times) + 0.02)).all()
        out = [t for t, x in path if x < largest]
        assert largest / (out[-1] - out[0]) <= rate * 1.1
        driver.arm(next_state(driver))  # and it can be armed again


def test_an_offset_that_registers_cannot_hold_is_refused(ur: ModbusCase) -> None:
    with ur.driver() as driver:
        driver.arm(next_state(driver))
        state = next_state(driver)
        q = driver.nominal_q(state)
        driver.gate.set_bounds(GateBounds(offset=0.1, offset_rate=1.0))
        with pytest.raises(
            WriteError, match=r"found an offset of 0\.04 m, expected at most 0\.0327"
        ):
            driver.write_setpoint(setpoint_of(state, q, q, (0.04, 0.0, 0.0, 0.0, 0.0, 0.0)))


def test_a_register_outside_the_allow_list_is_never_written(ur: ModbusCase) -> None:
    with ur.driver() as driver:
        for address in (128, 233, 245, 270):
            with pytest.raises(WriteError, match="the profile does not allow"):
                driver.transport.write("holding", address, [1])
        with pytest.raises(WriteError, match="the profile does not allow"):
            driver.transport.write("holding", 243, [1, 1, 1])
        with pytest.raises(WriteError, match="the profile does not allow"):
            driver.transport.write("coil", 236, [1])


def test_a_stopped_robot_is_not_armed_and_reports_why(ur: ModbusCase) -> None:
    with ur.driver() as driver:
        assert next_state(driver).safety_mode == 1
        ur.controller.protective_stop()
        wait_for(lambda: next_state(driver).safety_mode == 3, "the stop")
        with pytest.raises(
            WriteError, match=r"security stopped \(holding 261\): found 1, expected"
        ):
            driver.arm(next_state(driver))
        ur.controller.unlock()
        ur.controller.emergency_stop()
        wait_for(lambda: next_state(driver).safety_mode == 7, "the button")


def test_registers_too_coarse_for_the_offset_are_reported_before_arming(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        "robot: {model: ur10e}\npayload: {mass: 5.0}\n"
        f"compliance: {{axial: [{', '.join(['1.0e-6'] * 6)}]}}\n"
    )
    with ModbusCase("niryo") as case:
        driver = ModbusDriver(case.settings, load_cell(path).model, clock=SYSTEM)
        with driver:
            before = np.array(case.controller.q)
            with pytest.raises(
                WriteError,
                match=r"Niryo One's target registers are too coarse: one count \(1 mrad\) times "
                r"the reach \(1\.\d+ m\) is 1\.\d+ mm, and the offset at hand is 0\.\d+ mm",
            ):
                driver.arm(next_state(driver))
            assert np.abs(before - case.controller.q).max() < 1e-9
        coarse = case.settings.model_copy(update={"coarsest": 0.005})
        with ModbusDriver(coarse, load_cell(path).model, clock=SYSTEM) as driver:
            driver.arm(next_state(driver))


def test_a_target_that_the_robot_refuses_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    with ModbusCase("niryo") as case, case.driver() as driver:
        state = next_state(driver)
        driver.arm(state)
        q = state.actual_q + 0.02

        def refuse(_: object) -> None:
            raise BenchError("move: outside what this controller allows")

        monkeypatch.setattr(case.controller, "move_own", refuse)
        with pytest.raises(WriteError, match=r"last command .*found 2, expected 0 or 1"):
            stream(driver, lambda state, _: setpoint_of(state, q, q, (0.0,) * 6), PATIENCE)


def test_the_wrong_controller_is_reported_when_connecting() -> None:
    with ModbusCase(str(INVENTED)) as case:
        server = case.servers[0]
        assert isinstance(server, ModbusServer)
        other = server.profile.identity[0].model_copy(update={"good": [2]})
        server.profile = server.profile.model_copy(update={"identity": [other]})
        case.run_cycles()
        with pytest.raises(LinkError, match=r"map version \(holding 4\): found 2, expected 3: not"):
            case.driver().connect()


def test_a_map_with_the_wrong_word_order_is_reported_when_connecting(tmp_path: Path) -> None:
    path = tmp_path / "wrong.yaml"
    text = (ModbusSettings.shipped / "igus.yaml").read_text()
    path.write_text(text.replace("type: i32, word_order: low_first", "type: i32", 1))
    with ModbusCase("igus") as case:
        wrong = case.settings.model_copy(update={"profile": str(path)})
        with pytest.raises(LinkError, match=r"actual_q_\d: found -?\d+"):
            ModbusDriver(wrong, case.model, clock=SYSTEM).connect()


def test_a_register_that_is_not_there_is_reported_when_connecting() -> None:
    with ModbusCase("xarm") as case:
        wide = ModbusDriver(case.settings, case.model, clock=SYSTEM)
        wide._first_block = dataclasses.replace(wide._first_block, count=12)
        with pytest.raises(LinkError, match="the controller refuses: illegal address"):
            wide.connect()
