"""Register requests over Modbus TCP, plain or TLS, on the socket that pymodbus has opened.

Framing is the library's. What stands between its framer and its calls makes objects of requests and
answers, register by register, and texts of both for its log, so that what every cycle asks for
(functions 3, 4, 16, 23) goes round it. Everything else (coils, single registers, serial lines) goes
through it.

Source: MODBUS Application Protocol Specification V1.1b3, 6.3, 6.4, 6.12, 6.17.
"""

from __future__ import annotations

import socket
import ssl
import struct
import sys
import time
from collections.abc import Sequence
from typing import Any

from pymodbus.framer import FramerBase

from gapbridge.core.errors import InvalidStateError

LONGEST = 260  # bytes of header and PDU
REFUSED = 0x80  # added to the function where the controller refuses
SPAN = struct.Struct(">BHH")  # function, first register, how many
EXCEPTIONS = {
    1: "illegal function", 2: "illegal address", 3: "illegal value", 4: "device failure",
    5: "acknowledge", 6: "device busy", 10: "no path to the device",
    11: "the device does not answer",
}  # fmt: skip


class TcpRequests:
    """One request after the other on one socket; an answer is that of the last request or none."""

    def __init__(self, client: Any, device_id: int, timeout: float) -> None:
        """Take a client of pymodbus that is connected."""
        self._link: socket.socket = client.socket
        self._framer: FramerBase = client.framer
        self._device, self._timeout = device_id, timeout
        self._transaction = 0
        self._mode: float | None = timeout
        if sys.platform.startswith("linux") and not isinstance(self._link, ssl.SSLSocket):
            # the kernel itself gives up: no call that waits before each that sends or receives
            limit = struct.pack("@ll", *divmod(int(1e6 * timeout), 1_000_000))
            self._link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
            self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
            self._mode = None

    def ask(self, request: bytes) -> bytes:
        """Send a PDU; returns the answer's.

        Raises InvalidStateError where what comes is no answer to it, TimeoutError where nothing
        comes, OSError where the link broke. The socket is of no more use after any of them.
        """
        try:
            return self._ask(request)
        except BlockingIOError:
            raise TimeoutError from None

    def _ask(self, request: bytes) -> bytes:
        link, framer = self._link, self._framer
        if link.gettimeout() != self._mode:
            link.settimeout(self._mode)  # the library leaves it at another one
        self._transaction = number = self._transaction % 0xFFFF + 1
        link.sendall(framer.encode(request, self._device, number))
        data = link.recv(LONGEST)
        size, device, found, answer = framer.decode(data)
        if not size:  # it comes in pieces
            data = self._rest(data)
            size, device, found, answer = framer.decode(data)
        if (found, device, size) != (number, self._device, len(data)):
            raise InvalidStateError("found the answer to another request")
        return answer

    def _rest(self, data: bytes) -> bytes:
        """Return data with as much as makes a frame. Raises as ``ask`` does."""
        until = time.monotonic() + self._timeout
        more = data
        while not self._framer.decode(data)[0]:
            left = until - time.monotonic()
            if not more:
                raise ConnectionResetError("the controller has hung up")
            if left <= 0.0 or len(data) >= LONGEST:
                raise TimeoutError
            self._link.settimeout(left)
            more = self._link.recv(LONGEST)
            data += more
        return data


def read_request(function: int, first: int, count: int) -> bytes:
    """Return the PDU that asks for registers (function 3 or 4)."""
    return SPAN.pack(function, first, count)


def write_request(first: int, values: Sequence[int]) -> bytes:
    """Return the PDU that writes registers (function 16). Raises struct.error beyond 16 bits."""
    count = len(values)
    return struct.pack(f">BHHB{count}H", 16, first, count, 2 * count, *values)


def exchange_request(first: int, count: int, write: int, values: Sequence[int]) -> bytes:
    """Return the PDU that writes ``values`` from ``write`` on and then reads (function 23)."""
    size = len(values)
    return struct.pack(f">BHHHHB{size}H", 23, first, count, write, size, 2 * size, *values)


def read_registers(answer: bytes, function: int, count: int) -> bytes:
    """Return the registers that an answer to 3, 4 or 23 holds, two bytes each.

    Raises InvalidStateError.
    """
    _check(answer, function)
    if len(answer) != 2 + 2 * count or answer[1] != 2 * count:
        raise InvalidStateError(f"found {(len(answer) - 2) // 2} registers, expected {count}")
    return answer[2:]


def check_written(answer: bytes, first: int, count: int) -> None:
    """Refuse an answer that does not confirm function 16. Raises InvalidStateError."""
    _check(answer, 16)
    if answer != SPAN.pack(16, first, count):
        raise InvalidStateError(f"found {answer[1:].hex(' ')} as the answer to a write")


def _check(answer: bytes, function: int) -> None:
    """Refuse a refusal, and an answer to another function."""
    if answer and answer[0] == function:
        return
    found, code = [*answer[:2], 0, 0][:2]
    if found == function | REFUSED:
        raise InvalidStateError(refusal(code))
    raise InvalidStateError(f"found an answer to function {found}, expected {function}")


def refusal(code: int) -> str:
    """Return what an exception code says."""
    return f"the controller refuses: {EXCEPTIONS.get(code, f'exception {code}')}"
