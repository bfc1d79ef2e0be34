"""Other people's clients read our servers; our driver reads other people's server."""

from __future__ import annotations

import shutil
import subprocess
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from contract_checks import check_reads, next_state
from contract_modbus import ModbusCase
from patience import PATIENCE
from ports import own_host

from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.simulated.modbus import image
from gapbridge.drivers.simulated.modbus.server import ModbusServer

pyModbusTCP = pytest.importorskip("pyModbusTCP", reason="pyModbusTCP is not installed")


@pytest.fixture
def case() -> Iterator[ModbusCase]:
    with ModbusCase("ur") as found:
        found.run_cycles()
        yield found


def joints_of(values: list[int], turns: list[int]) -> np.ndarray:
    """The angles as UR's page says: mrad within a turn, and revolutions."""
    signed = [t - 65536 if t > 32767 else t for t in turns]
    return np.array(values) / 1000.0 + 2.0 * np.pi * np.array(signed)


def mbpoll(case: ModbusCase, table: str, first: int, count: int, *more: str) -> str:
    tool = shutil.which("mbpoll")
    if tool is None:
        pytest.skip("mbpoll (libmodbus) is not installed: apt-get install mbpoll")
    found = subprocess.run(
        [tool, "-0", "-1", "-q", "-a", "1", "-p", str(case.settings.port), "-t", table, "-r",
         str(first), *(["-c", str(count)] if count else []), case.host, *more],
        capture_output=True, text=True, check=False, timeout=PATIENCE,
    )  # fmt: skip
    assert found.returncode == 0, found.stdout + found.stderr
    return found.stdout


def read_by_mbpoll(case: ModbusCase, table: str, first: int, count: int) -> list[int]:
    lines = mbpoll(case, table, first, count).splitlines()
    found = [line.split("\t")[1].split()[0] for line in lines if line.startswith("[")]
    assert len(found) == count
    return [int(text) & 0xFFFF for text in found]


def test_mbpoll_reads_the_joints_of_our_server(case: ModbusCase) -> None:
    values, turns = read_by_mbpoll(case, "4", 270, 6), read_by_mbpoll(case, "4", 320, 6)
    assert np.abs(joints_of(values, turns) - case.controller.q).max() <= 6e-4


def test_mbpoll_writes_and_reads_back_a_general_register(case: ModbusCase) -> None:
    mbpoll(case, "4", 236, 0, "1234")
    case.run_cycles()
    assert read_by_mbpoll(case, "4", 236, 1) == [1234]


def test_pymodbustcp_reads_registers_and_coils_of_our_server() -> None:
    from pyModbusTCP.client import ModbusClient

    with ModbusCase("igus") as case:
        case.run_cycles()
        client = ModbusClient(case.host, case.settings.port, unit_id=1, timeout=2.0)
        words = client.read_input_registers(142, 12)
        assert words is not None
        counts = [np.int32(np.uint32(words[i] | words[i + 1] << 16)) for i in range(0, 12, 2)]
        assert np.abs(np.radians(0.01 * np.array(counts)) - case.controller.q).max() <= 1e-4
        assert client.read_coils(53, 8) == [True, *[False] * 6, True]  # motors on, referenced
        assert client.read_coils(112, 1) == [False]
        assert client.read_holding_registers(1, 1) is None  # no such register: an exception
        client.close()


def test_our_driver_reads_a_server_that_is_not_pymodbus() -> None:
    """pyModbusTCP's own server, filled as a UR's, with a mailbox written to it."""
    from pyModbusTCP.server import ModbusServer as OtherServer

    case, host = ModbusCase("ur"), own_host()
    server = case.servers[0]
    assert isinstance(server, ModbusServer)
    other = OtherServer(host, 15503, no_block=True)
    other.start()
    ended = threading.Event()

    def fill() -> None:
        while not ended.is_set():
            case.controller.cycle()
            bank = other.data_bank
            words = bank.get_holding_registers(234, 11)
            server.program.cycle(case.controller, lambda *_, w=words: w)
            found = image.state_registers(case.file, image.readings(case.controller))["holding"]
            spots = image.condition_registers(case.file.status, frozenset())
            spots += server.program.registers(case.controller)
            found.update({address: value for _, address, value in spots})
            for address, value in found.items():
                bank.set_holding_registers(address, [value])
            time.sleep(case.controller.period)

    thread = threading.Thread(target=fill, daemon=True)
    thread.start()
    try:
        settings = case.settings.model_copy(update={"host": host, "port": 15503})
        with ModbusDriver(settings, case.model, clock=SYSTEM) as driver:
            check_reads(driver, case.model)
            driver.arm(next_state(driver))
            driver.release()
            assert np.abs(next_state(driver).actual_q - case.controller.q).max() <= case.resolution
    finally:
        ended.set()
        thread.join(PATIENCE)
        other.stop()
