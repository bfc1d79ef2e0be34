"""Modbus through the mailbox: requests and answers in memory, to the simulated robot's program."""

from __future__ import annotations

import math
import random
import struct
from typing import Any

from pymodbus.client.mixin import ModbusClientMixin
from pymodbus.exceptions import ModbusIOException
from pymodbus.pdu import DecodePDU, ModbusPDU

from benchmarks.simulation.links import SimulatedLink
from benchmarks.simulation.world import Process
from gapbridge.core.errors import InvalidStateError, LinkError
from gapbridge.core.state import RobotState
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.modbus import driver as modbus_driver
from gapbridge.drivers.modbus import encode
from gapbridge.drivers.modbus.driver import ModbusDriver
from gapbridge.drivers.modbus.profile import MAILBOX_WORDS
from gapbridge.drivers.modbus.registers import Table
from gapbridge.drivers.modbus.transport import Transport
from gapbridge.drivers.simulated.modbus.programs import MailboxProgram
from gapbridge.drivers.simulated.modbus.server import ModbusServer
from gapbridge.drivers.simulated.server.arm_controller import ArmController

ADDRESS_MISSING = 2  # exception code
MODE, RUNNING = 258, 7  # register of the robot's mode, and its value when it can move
HUNDREDTH = math.radians(0.01)
TARGETS, SPEED, TRIGGER = 142, 180, 103  # of igus: holding registers, holding register, coil
WRONG: tuple[tuple[Table, int, int], ...] = (  # of igus: an error, motors off, not referenced
    ("input", 95, 1), ("input", 95, 7), ("coil", 53, 0), ("coil", 60, 0),
)  # fmt: skip
MODES = (-1, 0, 1, 2, 3, 4, 5, 6)  # all others


class _Transport(Transport):
    """The product's, whose connection is the link's wires."""

    link: ModbusLink

    def open(self) -> None:
        """Connect. Raises LinkError."""
        self.close()
        self.link.clock.sleep(0.002)
        if not self.link.reachable:
            raise LinkError(f"{self.name}: cannot be reached: refused")
        self.link.reconnected()
        self._client = client = _Client(self.link, self._settings.timeout)
        self._calls = {
            "coil": client.read_coils, "holding": client.read_holding_registers,
            "input": client.read_input_registers,
        }  # fmt: skip


class _Client(ModbusClientMixin[ModbusPDU]):
    """The library's client, whose bytes go over the link's wires."""

    def __init__(self, link: ModbusLink, timeout: float) -> None:
        super().__init__()
        self._requests, self._decoder = _Requests(link, timeout), DecodePDU(False)

    def execute(self, no_response_expected: bool, request: ModbusPDU) -> ModbusPDU:
        """Send a request, and return what answers it."""
        try:
            data = self._requests.ask(bytes([request.function_code]) + request.encode())
        except TimeoutError:
            raise ModbusIOException("No response received after 0 retries") from None
        except InvalidStateError:
            raise ModbusIOException("request asks for id=1 but received id=2") from None
        found = self._decoder.decode(data)
        if found is None:
            raise ModbusIOException("Unable to decode request")
        found.dev_id, found.transaction_id = request.dev_id, request.transaction_id
        return found

    def close(self) -> None:
        """Do nothing: the link's wires stay."""


class _Requests:
    """Asks one question after the other."""

    def __init__(self, link: ModbusLink, timeout: float) -> None:
        self._link, self._timeout, self._number = link, timeout, 0
        self._generation = link.generation
        self._answer: tuple[int, bytes] | None = None

    def ask(self, request: bytes) -> bytes:
        """Return the answer. Raises TimeoutError, OSError, InvalidStateError."""
        link, world = self._link, self._link.world
        if link.up.is_cut or self._generation != link.generation:
            raise ConnectionResetError(104, "Connection reset by peer")
        self._number += 1
        link.note_request(request)
        process = world.current
        assert process is not None
        link.waiting = (process, self)
        link.up.send((self._number, self._generation, request))
        until = world.now + self._timeout
        while self._answer is None or self._answer[0] != self._number:
            left = until - world.now
            if left <= 0.0:
                raise TimeoutError
            if self._generation != link.generation:
                raise ConnectionResetError(104, "Connection reset by peer")
            process.sleep(left)
        if self._answer[1] == b"":
            raise InvalidStateError("found the answer to another request")
        return self._answer[1]

    def take(self, number: int, answer: bytes) -> None:
        """Take what has come."""
        self._answer = (number, answer)


class _Server(ModbusServer):
    """The simulated robot's, whose image of a cycle is laid out where somebody reads it."""

    is_due = True

    def _publish(self, controller: ArmController) -> None:
        self.is_due = True

    def lay_out(self, controller: ArmController) -> None:
        """Lay out the last cycle's image."""
        if self.is_due:
            self.is_due = False
            super()._publish(controller)


class ModbusLink(SimulatedLink):
    """One controller with a Modbus server and the mailbox program."""

    joints_in = reports = (3, 23)  # functions whose answer has the joints; that ends a reading

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.period = 0.008  # s: the server's, whatever the client's rate
        self.generation = 0
        self.waiting: tuple[Process, _Requests] | None = None
        self._server: _Server | None = None
        self._published = self.world.now
        self._image_sampled = self.world.now
        self.robot_mode = RUNNING
        self._asked_image = self.world.now  # sampling time of the image last answered

    @property
    def server(self) -> _Server:
        """Return the simulated robot's side; nothing of it listens."""
        if self._server is None:
            driver = self.setting.make_driver(modbus_driver, ModbusDriver, self.clock)
            self._server = _Server(driver.profile, "127.0.0.9", 15020)
            self._server.lay_out(self.controller)
        return self._server

    @property
    def program(self) -> MailboxProgram:
        """Return the robot's program."""
        assert isinstance(self.server.program, MailboxProgram)
        return self.server.program

    def driver(self) -> Driver:
        """See SimulatedLink.driver."""
        found = self.setting.make_driver(modbus_driver, ModbusDriver, self.clock)
        found.transport.__class__ = _Transport
        found.transport.link = self  # type: ignore[attr-defined]
        link, read = self, found._read_state

        def read_state() -> RobotState:
            state = read()
            link._sampled[state.received] = link._asked_image
            return state

        found._read_state = read_state  # type: ignore[method-assign]
        return found

    def key_of(self, state: RobotState) -> float:
        """See SimulatedLink.key_of."""
        return state.received

    def note_request(self, request: bytes) -> None:
        """Report a request that leaves the client."""
        function = request[0]
        if function in (16, 23):
            at = 1 if function == 16 else 5
            address, count = struct.unpack_from(">HH", request, at)
            words = list(struct.unpack_from(f">{count}H", request, at + 5))
            self._note_mailbox(address, words)

    def _note_mailbox(self, address: int, words: list[int]) -> None:
        box: Any = self.server.profile.write
        if address != box.address or len(words) != MAILBOX_WORDS:
            self.wrote("forbidden", (), f"holding {address}")
            return
        if encode.checksum(words[:-1]) != words[-1]:
            self.wrote("broken", (), "mailbox")
            return
        self.wrote("offset", tuple(float(v) for v in encode.offset_of(box, words[1:7])), "mailbox")

    def cycle(self) -> None:
        """Have the robot scan its registers."""
        program, running = self.program, self.program.running
        program.running = running and not self.is_paused
        self.server.cycle(self.controller)
        program.running = running
        self._image_sampled = self.world.now

    def publish(self) -> None:
        """Send nothing: it only answers."""

    def _on_up(self, message: tuple[int, int, bytes]) -> None:
        number, generation, request = message
        if self.controller.stalled or self.world.now < self.rebooting_until:
            return
        self.down.send((number, generation, self._answer(request), self._image_sampled))

    def _answer(self, request: bytes) -> bytes:
        function, server = request[0], self.server
        if function in (5, 6, 16):
            address, count = struct.unpack_from(">HH", request, 1)
            words = [count] if function != 16 else [*struct.unpack_from(f">{count}H", request, 6)]
            words = [int(bool(count))] if function == 5 else words
            server._queue.append(("coil" if function == 5 else "holding", address, words))
            return struct.pack(">BHH", function, address, count)
        if function == 23:
            first, count, address, size = struct.unpack_from(">HHHH", request, 1)
            words = [*struct.unpack_from(f">{size}H", request, 10)]
            server._queue.append(("holding", address, words))
        else:
            first, count = struct.unpack_from(">HH", request, 1)
        server.lay_out(self.controller)
        table: Table = {1: "coil", 4: "input"}.get(function, "holding")  # type: ignore[assignment]
        image = server._image[table]
        values = [image.get(a, 0) & 0xFFFF for a in range(first, first + count)]
        self._have_mode_in(table, first, values)
        if function == 1:
            bits = sum(bool(value) << i for i, value in enumerate(values))
            return bytes([1, (count + 7) // 8]) + bits.to_bytes((count + 7) // 8, "little")
        return struct.pack(f">BB{count}H", function, 2 * count, *values)

    def _have_mode_in(self, table: Table, first: int, values: list[int]) -> None:
        """Have the robot's mode be among the registers of an answer."""
        if self.robot_mode != RUNNING and 0 <= MODE - first < len(values):
            values[MODE - first] = self.robot_mode & 0xFFFF

    @property
    def _is_safe(self) -> bool:
        return self.controller.can_move and self.robot_mode == RUNNING

    def _answers_bare(self) -> bool:
        """Return whether the program says in the last image that it applies no offset."""
        box: Any = self.server.profile.write
        table, first = self.server._image[box.echo_table], box.echo_address + 2
        return not any(table[first + i] for i in range(6))

    def _on_down(self, message: tuple[int, int, bytes, float]) -> None:
        number, generation, answer, sampled = message
        if self.waiting is None or generation != self.generation:
            return
        process, requests = self.waiting
        controller, function = self.controller, next(iter(answer), 0)
        if function in self.joints_in:
            self._asked_image = sampled
        if function in self.reports:
            q, target = controller.q, controller.target_q
            self.see((math.nan, q, target, self._is_safe), self._answers_bare())
        requests.take(number, answer)
        process.wake()

    def reconnected(self) -> None:
        """Have wires carry again; what the last connection's requests come to reaches nobody."""
        super().reconnected()
        self.generation += 1

    def disconnect(self) -> None:
        """See SimulatedLink.disconnect."""
        super().disconnect()
        self.generation += 1
        if self.waiting is not None:
            self.waiting[0].wake()

    def forget_client(self) -> None:
        """See SimulatedLink.forget_client."""
        super().forget_client()
        self._set_program(False)

    def heal(self) -> None:
        """See SimulatedLink.heal."""
        super().heal()
        self._set_program(True)

    def _set_program(self, runs: bool) -> None:
        self.program.running = runs

    def enter_mode(self, draw: random.Random) -> str:
        """See SimulatedLink.enter_mode."""
        self.robot_mode = draw.choice(MODES)
        self.program.running = False
        return f"robot mode {self.robot_mode}"

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode."""
        self.robot_mode = RUNNING

    def foreign(self, seconds: float) -> None:
        """Have somebody else write the mailbox, for a while."""
        box: Any = self.server.profile.write
        until = self.world.now + seconds

        def write(number: int) -> None:
            words = encode.mailbox_words(
                number % 60000 + 1, [0] * 6, number % 60000 + 1, [200, 800]
            )
            self.server._queue.append(("holding", box.address, words))
            if self.world.now < until:
                self.world.after(0.01, lambda: write(number + 1))

        write(31000)


class ModbusTargetLink(ModbusLink):
    """An igus controller: targets of the joints, and a coil that starts the motion there."""

    joints_in, reports = (4,), (1,)

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.period = 0.02
        self._goal: tuple[float, ...] = ()
        self._mode: tuple[Table, int, int] | None = None  # register that says what is wrong

    def note_request(self, request: bytes) -> None:
        """Report a request that leaves the client; the coil makes a setpoint of the target."""
        function, address, value = struct.unpack_from(">BHH", request)
        if function in (1, 4):
            return
        if function == 5 and address == TRIGGER and value:
            self.wrote("joints", self._goal, f"coil {TRIGGER}")
            return
        fine = (function, address) in ((5, TRIGGER), (6, SPEED))
        if function == 16 and address == TARGETS and value == 2 * self.controller.n:
            words = struct.unpack_from(f">{value}H", request, 6)
            low_first = b"".join(word.to_bytes(2, "little") for word in words)
            counts = struct.unpack(f"<{self.controller.n}i", low_first)
            self._goal = tuple(HUNDREDTH * count for count in counts)
            fine = True
        self.wrote("other" if fine else "forbidden", (), f"function {function} at {address}")

    def cycle(self) -> None:
        """Have the robot scan its registers."""
        self.server.cycle(self.controller)
        self._image_sampled = self.world.now

    def _have_mode_in(self, table: Table, first: int, values: list[int]) -> None:
        if self._mode is not None:
            where, address, value = self._mode
            if where == table and 0 <= address - first < len(values):
                values[address - first] = value

    @property
    def _is_safe(self) -> bool:
        return self.controller.can_move and self._mode is None

    def _answers_bare(self) -> bool:
        return False

    def _set_program(self, runs: bool) -> None:
        """Do nothing: the controller's own program moves."""

    def enter_mode(self, draw: random.Random) -> str:
        """See SimulatedLink.enter_mode."""
        self._mode = draw.choice(WRONG)
        self.controller.stop_own()
        return f"{self._mode[0]} {self._mode[1]} is {self._mode[2]}"

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode."""
        self._mode = None

    def foreign(self, seconds: float) -> None:
        """Have somebody else send the arm where it is, for a while."""
        until = self.world.now + seconds

        def write() -> None:
            counts = [round(q / HUNDREDTH) for q in self.controller.q]
            words = struct.unpack(f"<{2 * len(counts)}H", struct.pack(f"<{len(counts)}i", *counts))
            queue = self.server._queue
            queue.append(("holding", TARGETS, [*words]))
            queue.extend(("coil", TRIGGER, [value]) for value in (0, 1))
            if self.world.now < until:
                self.world.after(0.05, write)

        write()


def spoiled(message: tuple[int, int, bytes, float], draw: Any) -> tuple[int, int, bytes, float]:
    """Return an answer that is wrong in one way."""
    number, generation, answer, sampled = message
    kind = draw.randrange(6)
    if kind == 0:
        answer = answer[:-2]
    elif kind == 1:
        answer = bytes([answer[0] ^ 1]) + answer[1:]
    elif kind == 2:
        answer = bytes([answer[0] | 0x80, ADDRESS_MISSING])
    elif kind == 3:
        answer = b""
    elif kind == 4:
        at = draw.randrange(len(answer))
        answer = answer[:at] + bytes([answer[at] ^ (1 << draw.randrange(8))]) + answer[at + 1 :]
    else:
        answer = answer[:2] + bytes(len(answer) - 2)
    return number, generation, answer, sampled


def spoiled_request(message: tuple[int, int, bytes], draw: Any) -> tuple[int, int, bytes]:
    """Return a request with one bit of what it writes wrong."""
    number, generation, request = message
    first = {16: 6, 23: 10}.get(request[0], len(request))
    if first < len(request):
        at = draw.randrange(first, len(request))
        request = request[:at] + bytes([request[at] ^ 1 << draw.randrange(8)]) + request[at + 1 :]
    return number, generation, request
