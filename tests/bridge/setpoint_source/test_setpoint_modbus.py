"""A PLC writes setpoints over Modbus TCP and reads what became of them."""

from __future__ import annotations

import mmap
import os
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clock_by_hand import ByHand
from daemon_cell import Robot, Run
from patience import wait_for
from ports import free_port

from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.bridge.setpoint_source.modbus import ModbusSource
from gapbridge.bridge.setpoint_source.plc_memory import PlcMemory
from gapbridge.bridge.setpoint_source.source import SourceDryError, SourceStatus
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import SYSTEM

client_library = pytest.importorskip("pyModbusTCP.client", reason="pyModbusTCP is not installed")
HERE = np.array([0.1, -0.2, 0.3])
UNIT = 1e-6


def words_of(values: np.ndarray) -> list[int]:
    found = []
    for count in np.round(values / UNIT).astype(int).tolist():
        found += [count >> 16 & 0xFFFF, count & 0xFFFF]
    return found


def numbers_of(phrase: list[int]) -> np.ndarray:
    high, low = np.array(phrase[0::2], np.uint32), np.array(phrase[1::2], np.uint32)
    return (high << 16 | low).astype(np.int32) * UNIT


class Plc:
    def __init__(self, host: str, port: int) -> None:
        self.client = client_library.ModbusClient(host, port, unit_id=3, timeout=2.0)
        self.sequence = 0

    def put(self, q: np.ndarray) -> None:
        self.sequence = self.sequence % 60000 + 1
        assert self.client.write_multiple_registers(0, [self.sequence, 0, *words_of(q)])

    def inputs(self) -> list[int]:
        found = self.client.read_input_registers(0, 62)
        assert found is not None
        return found


@pytest.fixture
def source() -> Iterator[ModbusSource]:
    settings = SetpointSettings(source="modbus", port=0, timeout=1.0)
    made = make_source(settings, 3, True, Path(), clock=SYSTEM)
    assert isinstance(made, ModbusSource)
    made.open()
    yield made
    made.close()
    made.close()


def first_of(source: ModbusSource) -> np.ndarray:
    wait_for(lambda: source.first(HERE) is not None, "a setpoint")
    found = source.first(HERE)
    assert found is not None
    return found


def test_what_a_plc_writes_is_the_setpoint(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    assert source.first(HERE) is None
    plc.put(HERE)
    assert first_of(source) == pytest.approx(HERE, abs=UNIT)
    source.begin(0.0, HERE)
    plc.put(HERE + 0.01)
    wait_for(lambda: bool(np.allclose(source.sample(0.0, HERE), HERE + 0.01, atol=UNIT)), "it")


def test_joints_without_a_new_sequence_number_are_no_setpoint(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    plc.put(HERE)
    first_of(source)
    assert plc.client.write_multiple_registers(2, words_of(HERE + 0.5))
    time.sleep(0.05)
    assert first_of(source) == pytest.approx(HERE, abs=UNIT)
    assert plc.client.write_single_register(0, 777)  # now they are
    wait_for(lambda: first_of(source)[0] > 0.5, "the joints")


def test_a_plc_that_falls_silent_is_dry(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    plc.put(HERE)
    first_of(source)
    source.begin(0.0, HERE)
    time.sleep(1.1)
    with pytest.raises(SourceDryError, match="found no new sequence number for"):
        source.sample(0.0, HERE)


def test_a_plc_reads_state_corrected_joints_and_offset(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    plc.put(HERE)
    first_of(source)
    assert plc.inputs()[:6] == [1, 3, 0, 0, 0, 0]
    offset = np.array([1e-3, -2e-3, 3e-4, 1e-4, -2e-4, 0.0])
    source.emit(SourceStatus(State.COMPENSATING, HERE, HERE + 0.002, offset, True, 0))
    found = plc.inputs()
    assert found[:6] == [1, 3, 3, plc.sequence, 1, 1]
    assert numbers_of(found[10:16]) == pytest.approx(HERE + 0.002, abs=UNIT)
    assert numbers_of(found[30:36]) == pytest.approx(HERE, abs=UNIT)
    assert numbers_of(found[50:62]) == pytest.approx(offset, abs=UNIT)


def test_a_server_that_has_died_ends_the_process_once_nothing_is_written() -> None:
    """Else no PLC could connect any more, and nobody would know why."""
    clock = ByHand()
    settings = SetpointSettings(source="modbus", port=0, timeout=1.0)
    source = make_source(settings, 3, True, Path(), clock=clock)
    assert isinstance(source, ModbusSource)

    def seconds(state: State, count: float) -> None:
        for _ in range(round(100 * count)):
            clock.sleep(0.01)
            source.emit(SourceStatus(state, HERE, HERE, np.zeros(6), False, 0))

    source.open()
    try:
        for state in State:
            seconds(state, 2.0)
        assert source._server is not None
        source._server.kill()
        source._server.wait()
        seconds(State.COMPENSATING, 3.0)
        seconds(State.HOLDING, 3.0)
        with pytest.raises(RunError, match=r"server for the PLC has ended \(exit code -9\)"):
            seconds(State.OBSERVING, 2.0)
    finally:
        source.close()


def test_mbpoll_reads_the_status(source: ModbusSource) -> None:
    tool = shutil.which("mbpoll")
    if tool is None:
        pytest.skip("mbpoll (libmodbus) is not installed: apt-get install mbpoll")
    found = subprocess.run(
        [tool, "-0", "-1", "-q", "-p", str(source.port), "-t", "3", "-r", "0", "-c", "2",
         "127.0.0.1"], capture_output=True, text=True, check=True, timeout=10,
    )  # fmt: skip
    assert [line.split("\t")[1].strip() for line in found.stdout.splitlines() if "\t" in line] == [
        "1", "3",
    ]  # fmt: skip


def test_registers_that_are_not_there_are_refused(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    assert not plc.client.write_multiple_registers(6, [0, 0, 0])
    assert plc.client.read_input_registers(60, 5) is None


@pytest.mark.slow
def test_a_taken_port_is_one_line(source: ModbusSource) -> None:
    settings = SetpointSettings(source="modbus", port=source.port)
    with pytest.raises(RunError, match="cannot listen on"):
        make_source(settings, 3, True, Path(), clock=SYSTEM).open()


def test_its_server_imports_nothing_from_the_working_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "json.py").write_text("raise SystemExit(7)\n")
    monkeypatch.chdir(tmp_path)
    settings = SetpointSettings(source="modbus", port=0)
    source = make_source(settings, 3, True, Path(), clock=SYSTEM)
    assert isinstance(source, ModbusSource)
    source.open()
    assert source.port  # its server has answered
    source.close()


def test_an_arm_of_too_many_joints_is_refused() -> None:
    with pytest.raises(InputError, match="found 11 joints, expected"):
        make_source(SetpointSettings(source="modbus"), 11, True, Path(), clock=SYSTEM)


def test_a_record_that_is_half_written_is_not_seen() -> None:
    memory = PlcMemory(3)
    server = PlcMemory(3, memory.fds)
    server.put_setpoint(1, HERE)
    assert memory.setpoint() is not None
    server._setpoint._map[:8] = (3).to_bytes(8, "little")  # a version that says: being written
    assert memory.setpoint() is None
    server._setpoint._map.close()
    server._status._map.close()
    memory.close()


def test_neither_side_can_write_what_is_the_others() -> None:
    memory = PlcMemory(3)
    server = PlcMemory(3, memory.fds)
    assert memory.is_sealed
    with pytest.raises((TypeError, ValueError)):
        memory.put_setpoint(1, HERE)
    with pytest.raises((TypeError, ValueError)):
        server.put_status((3, 0, 0, 0), np.zeros(12))
    for fd in memory.fds:
        with pytest.raises(PermissionError):
            os.pwrite(fd, b"x", 0)
        again = os.open(f"/proc/self/fd/{fd}", os.O_RDWR)
        with pytest.raises(PermissionError):
            mmap.mmap(again, 512)
        os.close(again)


@pytest.mark.slow
def test_the_arm_goes_where_the_plc_says_and_the_plc_hears_of_it(tmp_path: Path) -> None:
    with Robot(tmp_path) as robot:
        start = np.array(robot.settings.start_q)
        port = free_port()
        cell = robot.cell(setpoints=f"{{source: modbus, port: {port}, timeout: 0.5}}")
        with Run(cell, arm=True) as run:
            run.wait(State.ARMED)
            plc = Plc("127.0.0.1", port)
            begun = time.monotonic()
            seen: set[int] = set()
            while time.monotonic() - begun < 3.0:
                way = min((time.monotonic() - begun) * 0.05, 0.05)
                plc.put(start + way)
                seen.add(plc.inputs()[2])
                time.sleep(0.02)
            found = plc.inputs()
            corrected, nominal = numbers_of(found[10:22]), numbers_of(found[30:42])
            assert found[2] == State.COMPENSATING
            assert found[5] & 1
            assert nominal == pytest.approx(start + 0.05, abs=2e-5)
            assert 1e-5 < np.abs(corrected - nominal).max() < 0.01  # the arm bends
            assert np.linalg.norm(numbers_of(found[50:62])[:3]) > 1e-4
            run.wait(State.HOLDING)  # the PLC says no more
        assert {State.ARMED, State.COMPENSATING} & seen


def test_what_a_plc_wrote_before_arming_starts_nothing(source: ModbusSource) -> None:
    plc = Plc("127.0.0.1", source.port)
    plc.put(HERE)
    source.discard()
    assert source.first(HERE) is None
    plc.put(HERE + 0.1)
    assert first_of(source) == pytest.approx(HERE + 0.1, abs=UNIT)
