"""Answers that are wrong, late or none; encrypted links and serial ones."""

from __future__ import annotations

import contextlib
import hashlib
import os
import select
import ssl
import subprocess
import threading
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from contract_checks import OFFSET, check_reads, next_state, read_on, setpoint_of, stream, write
from contract_modbus import ModbusCase
from evil_proxy import EvilProxy, Ruin
from patience import PATIENCE, wait_for
from ports import free_port
from pymodbus.framer import FramerRTU

from benchmarks.server_thread import ServerThread
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.map import Block
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.modbus.transport import Transport
from gapbridge.drivers.simulated.modbus.server import ModbusServer

QUICK = {"timeout": 0.25, "state_timeout": 0.5}
# both ends are in this busy process: an answer may take longer than a cell allows
PATIENT = {"timeout": 5.0}


@pytest.fixture
def case() -> Iterator[ModbusCase]:
    with ModbusCase("ur") as found:
        yield found


@pytest.fixture
def proxy(case: ModbusCase) -> Iterator[EvilProxy]:
    assert case.settings.port is not None
    with EvilProxy(case.host, case.settings.port) as found:
        yield found


@contextlib.contextmanager
def driver_through(case: ModbusCase, proxy: EvilProxy) -> Iterator[ModbusDriver]:
    driver = ModbusDriver(
        case.settings.model_copy(update={"port": proxy.port, **QUICK}),
        case.model,
        clock=SYSTEM,
    )

    def is_connected() -> bool:
        with contextlib.suppress(StaleStateError):  # both ends are in this busy process
            driver.connect()
            return True
        return False

    wait_for(is_connected, "a link")
    try:
        yield driver
    finally:
        driver.close()


def other_function(answer: bytes) -> bytes:
    return answer[:7] + b"\x04" + answer[8:]


def fewer_registers(answer: bytes) -> bytes:
    return answer[:4] + b"\x00\x07" + answer[6:8] + b"\x04" + answer[9:13]


def more_registers(answer: bytes) -> bytes:
    count = answer[8] + 4
    length = (count + 3).to_bytes(2, "big")
    return answer[:4] + length + answer[6:8] + bytes([count]) + answer[9:] + b"\x12\x34\x56\x78"


def refusal(answer: bytes) -> bytes:
    return answer[:4] + b"\x00\x03" + answer[6:7] + bytes([answer[7] | 0x80, 6])


RUINS: dict[str, Ruin] = {
    "another function": other_function,
    "too few registers": fewer_registers,
    "too many registers": more_registers,
    "an exception": refusal,
    "transaction zero": lambda answer: b"\x00\x00" + answer[2:],
    "another transaction": lambda answer: b"\x7f\xff" + answer[2:],
    "another protocol": lambda answer: answer[:2] + b"\x00\x02" + answer[4:],
    "another device": lambda answer: answer[:6] + b"\x63" + answer[7:],
    "half an answer": lambda answer: answer[: len(answer) // 2],
    "noise": lambda answer: bytes(range(7, 200)),
}


@pytest.mark.parametrize("name", RUINS)
def test_a_ruined_answer_is_never_taken_and_the_link_recovers(
    case: ModbusCase, proxy: EvilProxy, name: str
) -> None:
    with driver_through(case, proxy) as driver:
        next_state(driver)
        proxy.ruin = RUINS[name]
        begun = time.monotonic()
        for _ in range(3):
            with pytest.raises((InvalidStateError, StaleStateError)):
                driver.read_state()
        assert time.monotonic() - begun < 10.0
        proxy.ruin = lambda answer: answer
        state = next_state(driver)
        assert np.abs(state.actual_q - case.controller.q).max() <= case.resolution


def test_a_late_answer_is_never_taken_for_the_next_ones(case: ModbusCase, proxy: EvilProxy) -> None:
    with driver_through(case, proxy) as driver:
        next_state(driver)
        proxy.wait = 0.35  # each comes when its request is given up
        with pytest.raises(StaleStateError, match="no new sample for"):
            driver.read_state()
        proxy.wait = 0.0
        goal = (case.controller.q[0] + 0.2, *case.controller.q[1:])
        case.controller.move_own(goal)
        wait_for(lambda: np.abs(np.subtract(case.controller.q, goal)).max() < 1e-9, "the pose")
        assert np.abs(next_state(driver).actual_q - goal).max() <= case.resolution


def test_an_answer_that_was_long_under_way_is_not_fresh(case: ModbusCase, proxy: EvilProxy) -> None:
    settings = case.settings.model_copy(
        update={"port": proxy.port, "timeout": 0.4, "state_timeout": 0.3}
    )
    with ModbusDriver(settings, case.model, clock=SYSTEM) as driver:
        next_state(driver)
        proxy.wait = 4.0 / driver.rate + 0.05  # as if this process had stood still meanwhile
        with pytest.raises(StaleStateError, match="no new sample for"):
            driver.read_state()
        proxy.wait = 0.0
        assert np.isfinite(next_state(driver).actual_q).all()


def test_a_readings_time_is_the_longest_way_of_its_state(
    case: ModbusCase, proxy: EvilProxy
) -> None:
    with driver_through(case, proxy) as driver:
        proxy.wait = 0.02
        next_state(driver)
        assert 0.02 <= driver.transit_time() <= (driver.round_trip() or 0.0)


@pytest.mark.realtime
def test_an_offset_whose_answer_is_lost_once_is_sent_once_more(
    case: ModbusCase, proxy: EvilProxy
) -> None:
    lost: list[bytes] = []

    def lose_one(answer: bytes) -> bytes:
        if answer[7] != 16 or lost:
            return answer
        lost.append(answer)
        return answer[:3]

    with driver_through(case, proxy) as driver:
        driver.arm(next_state(driver))
        proxy.ruin = lose_one

        def goes_on() -> bool:
            return bool(lost) and max(map(abs, case.controller.joint_offset)) > 1e-5

        stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), PATIENCE, goes_on)
        assert goes_on()


def test_a_controller_that_hangs_up_each_time_is_a_link_error(
    case: ModbusCase, proxy: EvilProxy
) -> None:
    with driver_through(case, proxy) as driver:
        next_state(driver)
        proxy.ruin = lambda answer: b""
        with pytest.raises(LinkError):
            driver.read_state()


# -- encrypted ---------------------------------------------------------------------------------


def openssl(folder: Path, *arguments: str) -> None:
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority, and keys of ours that it has signed."""
    folder = tmp_path_factory.mktemp("keys")
    openssl(
        folder, "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "ca.key", "-out",
        "ca.pem", "-days", "2", "-subj", "/CN=plant authority",
    )  # fmt: skip
    certify(folder, "client")
    return folder


def certify(folder: Path, name: str, made_out_to: str = "") -> str:
    """Have the authority sign a certificate, made out to an address; returns its SHA-256."""
    openssl(
        folder, "req", "-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-out",
        f"{name}.csr", "-subj", f"/CN={name}",
    )  # fmt: skip
    (folder / "san").write_text(f"subjectAltName=IP:{made_out_to}\n" if made_out_to else "")
    openssl(
        folder, "x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key",
        "-CAcreateserial", "-out", f"{name}.pem", "-days", "2", "-extfile", "san",
    )  # fmt: skip
    der = ssl.PEM_cert_to_DER_cert((folder / f"{name}.pem").read_text())
    return hashlib.sha256(der).hexdigest()


def test_the_contract_holds_over_mutual_tls(keys: Path) -> None:
    case = ModbusCase("ur")
    certify(keys, "server", case.host)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(keys / "server.pem", keys / "server.key")
    context.load_verify_locations(keys / "ca.pem")
    context.verify_mode = ssl.CERT_REQUIRED
    port = free_port(case.host)
    server = ModbusServer(case.robot_file, case.host, port, tls=context)
    settings = ModbusSettings(
        profile="ur", host=case.host, port=port, transport="tls", rate=50.0,
        authority=keys / "ca.pem", certificate=keys / "client.pem", key=keys / "client.key",
    ).model_copy(update=PATIENT)  # fmt: skip
    with ServerThread(case.controller, [server], case.host):
        with ModbusDriver(settings, case.model, clock=SYSTEM) as driver:
            check_reads(driver, case.model)
            driver.arm(next_state(driver))
            stream(driver, lambda state, q: setpoint_of(state, q, q, OFFSET), 0.5)
            driver.release()
        nobody = settings.model_copy(update={"certificate": None, "key": None})
        with pytest.raises(LinkError):
            ModbusDriver(nobody, case.model, clock=SYSTEM).connect()
        stranger = settings.model_copy(update={"authority": keys / "client.pem"})
        with pytest.raises(LinkError, match="cannot be reached"):
            ModbusDriver(stranger, case.model, clock=SYSTEM).connect()


def test_over_tls_only_the_named_or_the_pinned_controller_is_let_in(keys: Path) -> None:
    case = ModbusCase("ur")
    own = certify(keys, "other", "192.0.2.1")  # of the same authority, made out to another
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(keys / "other.pem", keys / "other.key")
    port = free_port(case.host)
    server = ModbusServer(case.robot_file, case.host, port, tls=context)
    base = {"profile": "ur", "host": case.host, "port": port, "transport": "tls", "rate": 50.0}
    with ServerThread(case.controller, [server], case.host):
        named = ModbusSettings(**base, authority=keys / "ca.pem").model_copy(update=PATIENT)
        with pytest.raises(LinkError, match="certificate is refused: IP address mismatch"):
            ModbusDriver(named, case.model, clock=SYSTEM).connect()
        for more in ({}, {"authority": keys / "ca.pem"}):
            pinned = ModbusSettings(**base, fingerprint=own, **more).model_copy(update=PATIENT)
            with ModbusDriver(pinned, case.model, clock=SYSTEM) as driver:
                check_reads(driver, case.model)
            changed = pinned.model_copy(update={"fingerprint": "0" * 64})
            with pytest.raises(LinkError, match=rf"SHA-256 {own}, expected 0+ \(link"):
                ModbusDriver(changed, case.model, clock=SYSTEM).connect()


def test_a_fingerprint_is_taken_as_tools_print_it() -> None:
    spelled = ":".join(["AB"] * 32)
    given = {"profile": "ur", "transport": "tls"}
    assert ModbusSettings(**given, fingerprint=spelled).fingerprint == "ab" * 32
    for wrong in (None, "ab" * 31, "zz" * 32):
        with pytest.raises(ValueError, match=r"fingerprint|expected 64"):
            ModbusSettings(**given, fingerprint=wrong)


# -- serial ------------------------------------------------------------------------------------


class Cable:
    """Two pseudo terminals with a thread between them that hands bytes on."""

    def __init__(self) -> None:
        ends = [os.openpty() for _ in range(2)]
        for pair in ends:
            for number in pair:
                tty.setraw(number)
        self.ports = [os.ttyname(slave) for _, slave in ends]
        self._masters = [master for master, _ in ends]
        self._cut = threading.Event()
        threading.Thread(target=self._carry, daemon=True).start()

    def _carry(self) -> None:
        one, other = self._masters
        while not self._cut.is_set():
            ready, _, _ = select.select([one, other], [], [], 0.05)
            for number in ready:
                os.write(other if number == one else one, os.read(number, 4096))

    def cut(self) -> None:
        """Hand nothing on any more."""
        self._cut.set()


def test_the_contract_holds_over_a_serial_line() -> None:
    case, cable = ModbusCase("ur"), Cable()
    ours, theirs = cable.ports
    server = ModbusServer(case.robot_file, case.host, 502, serial=theirs, baudrate=115200)
    settings = ModbusSettings(
        profile="ur", transport="rtu", serial=ours, baudrate=115200, rate=20.0
    )
    settings = settings.model_copy(update=PATIENT)
    with (
        ServerThread(case.controller, [server], case.host),
        ModbusDriver(settings, case.model, clock=SYSTEM) as driver,
    ):
        check_reads(driver, case.model)
        assert np.abs(next_state(driver).actual_q - case.controller.q).max() <= case.resolution
        for _ in range(10):
            write(driver, lambda state, q: setpoint_of(state, q, q, OFFSET))
        driver.release()
        cable.cut()
        with pytest.raises(StaleStateError):
            read_on(driver, 100)


@pytest.mark.realtime(limit=0.3)
def test_an_answer_that_comes_late_on_a_serial_line_is_not_that_to_the_next_request() -> None:
    """It has no number, and may be of other registers: of as many, it fits."""
    device, port = os.openpty()
    tty.setraw(device)
    tty.setraw(port)

    def answer(request: bytes) -> bytes:
        body = request[:2] + b"\x0c" + 6 * request[2:4]  # each register holds its first address
        return body + FramerRTU.compute_CRC(body).to_bytes(2, "big")

    def serve() -> None:
        first = os.read(device, 256)
        again.wait(PATIENCE)
        select.select([device], [], [], 0.1)  # the line is open again, the next request not sent
        os.write(device, answer(first))
        os.write(device, answer(os.read(device, 256)))

    again = threading.Event()
    server = threading.Thread(target=serve, daemon=True)
    server.start()
    settings = ModbusSettings(profile="ur", transport="rtu", serial=os.ttyname(port), timeout=0.5)
    transport = Transport(settings, 0, 1)
    transport.open()
    with pytest.raises(StaleStateError):
        transport.read(Block("holding", 10, 6))
    again.set()
    transport.open()
    assert transport.read(Block("holding", 20, 6)) == 6 * b"\x00\x14"
    transport.close()
    server.join(PATIENCE)


def test_a_serial_port_that_is_not_there_is_a_link_error() -> None:
    settings = ModbusSettings(profile="ur", transport="rtu", serial="/dev/ttyNowhere")
    with pytest.raises(LinkError, match=r"/dev/ttyNowhere device 1: cannot be reached"):
        ModbusDriver(settings, ModbusCase("ur").model, clock=SYSTEM).connect()
