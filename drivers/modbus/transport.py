"""One synchronous pymodbus client (TCP, TLS, RTU) whose answers are checked.

The library accepts an answer of another function or with too few registers, and raises its own
errors as well as the operating system's; here an answer matches its request, or raises LinkError.
"""

from __future__ import annotations

import hashlib
import logging
import socket
import ssl
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from pymodbus.client import ModbusSerialClient, ModbusTcpClient, ModbusTlsClient
from pymodbus.exceptions import ModbusException, ModbusIOException
from pymodbus.pdu import ModbusPDU

from gapbridge.core.errors import (
    InputError,
    InvalidStateError,
    LinkError,
    StaleStateError,
    WriteError,
)
from gapbridge.drivers.modbus.map import Block, RegisterMap
from gapbridge.drivers.modbus.registers import Table, wire_of
from gapbridge.drivers.modbus.settings import ModbusSettings

READ_FUNCTIONS: dict[Table, int] = {"coil": 1, "discrete": 2, "holding": 3, "input": 4}
WRITE_FUNCTIONS: dict[tuple[Table, bool], int] = {
    ("coil", True): 5, ("coil", False): 15, ("holding", True): 6, ("holding", False): 16,
}  # fmt: skip
"""Table and whether one value goes in a request of its own -> function."""
PIECE, MOST_PIECES = 256, 10  # bytes, pieces: what is read of a serial line that is opened
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # reported by our own errors instead
EXCEPTIONS = {
    1: "illegal function", 2: "illegal address", 3: "illegal value", 4: "device failure",
    5: "acknowledge", 6: "device busy", 10: "no path to the device",
    11: "the device does not answer",
}  # fmt: skip
"""Exception codes (MODBUS Application Protocol Specification V1.1b3, 7)."""


class CheckedContext(ssl.SSLContext):
    """A context whose sockets check the server's name or certificate.

    The Modbus library passes no name to ``wrap_socket``, and reconnects by itself; so the name is
    added here, and a pinned certificate is compared at the end of every handshake.
    """

    server_name: str
    pinned: bytes | None = None  # SHA-256 of the controller's certificate
    refused = ""  # why the last handshake failed, which the library does not report

    def note_refusal(self, detail: str) -> None:
        """Store why the last handshake failed; empty: it did not."""
        self.refused = detail

    def wrap_socket(self, *arguments: Any, **keys: Any) -> ssl.SSLSocket:
        """Return a TLS socket that checks its peer as it connects."""
        keys["server_hostname"] = self.server_name
        return super().wrap_socket(*arguments, **keys)


class _CheckedSocket(ssl.SSLSocket):
    """A socket that compares the peer's certificate with the pinned one."""

    def do_handshake(self, block: bool = False) -> None:
        """Shake hands. Raises SSLError if the certificate is not the pinned one."""
        context = self.context
        assert isinstance(context, CheckedContext)
        context.note_refusal("")
        try:
            super().do_handshake(block)
        except ssl.SSLCertVerificationError as error:
            context.note_refusal(f"its certificate is refused: {error.verify_message}")
            raise
        if context.pinned is None:
            return
        fingerprint = hashlib.sha256(self.getpeercert(binary_form=True) or b"").digest()
        if fingerprint != context.pinned:
            detail = (
                f"found a certificate with SHA-256 {fingerprint.hex()}, expected "
                f"{context.pinned.hex()} (link.fingerprint)"
            )
            context.note_refusal(detail)
            raise ssl.SSLError(1, detail)


class Transport:
    """Requests to one device; ``allow`` is the list of what may be written.

    Raises InputError where a file of the encryption cannot be used.
    """

    def __init__(self, settings: ModbusSettings, port: int, device_id: int) -> None:
        self._settings, self._port, self._device = settings, port, device_id
        if settings.transport == "tls":
            checked_context(settings)  # files that cannot be used are no reason to try again
        self._writable: frozenset[tuple[Table, int]] = frozenset()
        self._allowed: set[tuple[Table, int, int]] = set()  # runs that were looked up before
        self._client: Any = None
        self._owed = False  # an answer to a former request may still come
        self._calls: dict[Table, Any] = {}  # the client's methods that read

    def allow(self, compiled: RegisterMap) -> None:
        """Allow writing the registers of the map, and no others."""
        self._writable = compiled.writable
        self._allowed.clear()

    @property
    def name(self) -> str:
        """Return the controller's name in messages."""
        settings = self._settings
        if settings.transport == "rtu":
            return f"{settings.serial} device {self._device}"
        return f"{settings.host}:{self._port}"

    def open(self) -> None:
        """Connect. Raises LinkError."""
        self.close()
        client: Any = None
        try:
            client = self._make()
            fine = client.connect()
            if fine and self._owed and self._settings.transport == "rtu":
                _wait_for_silence(client.socket)
        except (ModbusException, OSError, ValueError) as error:
            if client is not None:
                client.close()
            raise LinkError(f"{self.name}: cannot be reached: {_words(error)}") from None
        if not fine:
            client.close()
            context = client.comm_params.sslctx
            why = context.refused if isinstance(context, CheckedContext) else ""
            raise LinkError(f"{self.name}: cannot be reached: {why or 'no answer or refused'}")
        if self._settings.transport in ("tcp", "tls") and client.socket is not None:
            client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._calls = {
            "coil": client.read_coils, "discrete": client.read_discrete_inputs,
            "holding": client.read_holding_registers, "input": client.read_input_registers,
        }  # fmt: skip
        self._client, self._owed = client, False

    def _make(self) -> Any:
        settings = self._settings
        if settings.transport == "rtu":
            return ModbusSerialClient(
                str(settings.serial), baudrate=settings.baudrate, parity=settings.parity,
                stopbits=settings.stopbits, timeout=settings.timeout, retries=0,
            )  # fmt: skip
        if settings.transport == "tls":
            return ModbusTlsClient(
                settings.host, port=self._port, sslctx=checked_context(settings),
                timeout=settings.timeout,
                retries=0,
            )  # fmt: skip
        return ModbusTcpClient(settings.host, port=self._port, timeout=settings.timeout, retries=0)

    @property
    def is_open(self) -> bool:
        """Return whether there is an open socket."""
        return self._client is not None

    def close(self) -> None:
        """Close the socket, which the library leaves open after some errors; may be repeated."""
        client, self._client = self._client, None
        if client is not None:
            client.close()

    # -- reading ----------------------------------------------------------------------------------

    def read(self, block: Block) -> bytes:
        """Return the registers (or bits, 0 and 1) of a block, two bytes each.

        Raises LinkError if the link is broken, InvalidStateError for an invalid answer.
        """
        table = block.table
        function = READ_FUNCTIONS[table]
        self._opened()
        answer = self._ask(
            self._calls[table], block.first, count=block.count, device_id=self._device
        )
        return check_answer(answer, function, block.count, f"{self.name}: {table}")

    def exchange(self, block: Block, address: int, values: Sequence[int]) -> bytes:
        """Write holding registers, then read a block of them, in one request (function 23)."""
        self._check_allowed("holding", address, values)
        answer = self._ask(
            self._opened().readwrite_registers, read_address=block.first, read_count=block.count,
            write_address=address, values=list(values), device_id=self._device,
        )  # fmt: skip
        return check_answer(answer, 23, block.count, f"{self.name}: holding")

    # -- writing ----------------------------------------------------------------------------------

    def write(
        self, table: Table, address: int, values: Sequence[int], single: bool = False
    ) -> None:
        """Write coils or holding registers; ``single``: one request each (functions 5 and 6).

        Raises WriteError if the map does not allow it or the controller refuses.
        """
        self._check_allowed(table, address, values)
        client = self._opened()
        one = single or len(values) == 1
        try:
            for start, chunk in _chunks(address, values, one):
                if table == "coil":
                    call = client.write_coil if one else client.write_coils
                else:
                    call = client.write_register if one else client.write_registers
                sent: Any = chunk[0] if one else chunk
                sent = bool(sent) if table == "coil" and one else sent
                function = WRITE_FUNCTIONS[table, one]
                answer = self._ask(call, start, sent, device_id=self._device)
                check_written(answer, function, start, len(chunk), f"{self.name}: {table}")
        except InvalidStateError as error:
            raise WriteError(str(error)) from None

    def _check_allowed(self, table: Table, address: int, values: Sequence[int]) -> None:
        run = (table, address, len(values))
        if run in self._allowed:
            return
        for i in range(len(values)):
            if (table, address + i) not in self._writable:
                raise WriteError(
                    f"{self.name}: {table} {address + i}: the profile does not allow it to be "
                    "written"
                )
        self._allowed.add(run)

    # -- one request ------------------------------------------------------------------------------

    def _opened(self) -> Any:
        if self._client is None:
            raise LinkError(f"{self.name}: found no connection, expected connect() first")
        return self._client

    def _ask(self, call: Any, *arguments: Any, **keys: Any) -> ModbusPDU:
        """Return the library's answer. Raises LinkError; the socket is closed then."""
        try:
            answer: ModbusPDU = call(*arguments, **keys)
        except ModbusIOException as error:
            if "but received" in str(error):  # the library's words for another device's or number
                self._give_up(
                    InvalidStateError(f"{self.name}: found the answer to another request")
                )
            self._give_up(StaleStateError(self._silence()))
        except (ModbusException, OSError) as error:
            self._give_up(LinkError(f"{self.name}: no answer: {_words(error)}"))
        except Exception as error:  # the library's own mistakes over broken frames
            self._give_up(
                InvalidStateError(
                    f"{self.name}: found an answer that cannot be read: {type(error).__name__}"
                )
            )
        return answer

    def _silence(self) -> str:
        return f"{self.name}: no answer within {self._settings.timeout:g} s"

    def _give_up(self, error: LinkError) -> NoReturn:
        """Close and raise: a late answer must not be taken for that to the next request."""
        self._owed = True
        self.close()
        raise error from None


def _wait_for_silence(line: Any) -> None:
    """Read a serial line until nothing comes for its timeout; ends on one that never is silent.

    An answer there has no number: one that is late would be taken for that to the next request.
    """
    for _ in range(MOST_PIECES):
        if not line.read(PIECE):
            return


def _chunks(address: int, values: Sequence[int], one: bool) -> Iterable[tuple[int, list[int]]]:
    if one:
        return [(address + i, [int(v)]) for i, v in enumerate(values)]
    return [(address, [int(v) for v in values])]


def _words(error: Exception) -> str:
    text = getattr(error, "strerror", None) or str(error) or type(error).__name__
    return " ".join(str(text).split()).removeprefix("Modbus Error: ")


def check_answer(answer: Any, function: int, count: int, where: str) -> bytes:
    """Return the registers or bits of an answer, two bytes each.

    Raises InvalidStateError where it is not one.
    """
    _check_function(answer, function, where)
    values = answer.bits[:count] if function in (1, 2) else answer.registers
    if len(values) != count:
        raise InvalidStateError(f"{where}: found {len(values)} registers, expected {count}")
    if function in (1, 2):
        return wire_of([int(v) for v in values])
    if min(values) < 0 or max(values) > 0xFFFF:
        raise InvalidStateError(f"{where}: found a register beyond 16 bits")
    return wire_of(values)


def check_written(answer: Any, function: int, address: int, count: int, where: str) -> None:
    """Refuse an answer that does not confirm a write of ``count``. Raises InvalidStateError."""
    _check_function(answer, function, where)
    if answer.address != address:
        raise InvalidStateError(f"{where}: found address {answer.address}, expected {address}")
    if function in (15, 16) and answer.count != count:
        raise InvalidStateError(f"{where}: found {answer.count} written, expected {count}")


def _check_function(answer: Any, function: int, where: str) -> None:
    if answer is None:
        raise InvalidStateError(f"{where}: found no answer")
    if answer.isError():
        code = getattr(answer, "exception_code", 0)
        words = EXCEPTIONS.get(code, f"exception {code}")
        raise InvalidStateError(f"{where}: the controller refuses: {words}")
    if answer.function_code != function:
        raise InvalidStateError(
            f"{where}: found an answer to function {answer.function_code}, expected {function}"
        )


def checked_context(settings: ModbusSettings) -> ssl.SSLContext:
    """Return a context that lets only the cell's controller in.

    With ``authority`` the certificate must come from there and be made out to ``host``; with
    ``fingerprint`` it must be that very one, whatever name it has. Raises InputError where a file
    cannot be used.
    """
    for name in ("authority", "certificate", "key"):
        path = getattr(settings, name)
        if path is not None and not path.is_file():
            raise InputError(f"{path}: found no file, expected PEM", ("link", name))
    context = CheckedContext(ssl.PROTOCOL_TLS_CLIENT)
    context.sslsocket_class = _CheckedSocket
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.server_name = settings.host
    if settings.fingerprint is not None:
        context.pinned = bytes.fromhex(settings.fingerprint)
    context.check_hostname = context.pinned is None
    context.verify_mode = ssl.CERT_NONE if settings.authority is None else ssl.CERT_REQUIRED
    try:
        if settings.authority is not None:
            context.load_verify_locations(settings.authority)
        if settings.certificate is not None:
            context.load_cert_chain(settings.certificate, settings.key)
    except OSError as error:
        raise InputError(
            f"authority, certificate, key: {error.strerror or error}, expected PEM files that can "
            "be read",
            ("link",),
        ) from None
    return context
