"""Register requests over Modbus TCP, plain or TLS, on the socket that pymodbus has opened.

The library makes objects, calls and texts for its log of every request and answer: twice the work
of a whole cycle of ours. What every cycle asks for (functions 3, 4, 16 and 23) is a header and some
numbers. Everything else (coils, single registers, serial lines) goes through the library.

Source: MODBUS Messaging on TCP/IP Implementation Guide V1.0b, 3.1.3 (header); MODBUS Application
Protocol Specification V1.1b3, 6.3, 6.4, 6.12, 6.17.
"""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Sequence

from core.errors import InvalidStateError

HEADER = struct.Struct(">HHHB")  # transaction, protocol (0), bytes that follow, device
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

    def __init__(self, link: socket.socket, device_id: int, timeout: float) -> None:
        self._link, self._device, self._timeout = link, device_id, timeout
        self._transaction = 0

    def ask(self, request: bytes) -> bytes:
        """Send a PDU; returns the answer's.

        Raises InvalidStateError where what comes is no answer to it, TimeoutError where nothing
        comes, OSError where the link broke. The socket is of no more use after any of them.
        """
        link = self._link
        link.settimeout(self._timeout)  # the library leaves it at another one
        self._transaction = number = self._transaction % 0xFFFF + 1
        link.sendall(HEADER.pack(number, 0, len(request) + 1, self._device) + request)
        data = link.recv(LONGEST)
        if len(data) < HEADER.size or len(data) < 6 + int.from_bytes(data[4:6], "big"):
            data = self._rest(data)
        found, protocol, length, device = HEADER.unpack_from(data)
        if (found, protocol, device) != (number, 0, self._device) or len(data) != 6 + length:
            raise InvalidStateError("found the answer to another request")
        return data[HEADER.size :]

    def _rest(self, data: bytes) -> bytes:
        """Return an answer that comes in pieces. Raises as ``ask`` does."""
        until = time.monotonic() + self._timeout
        while True:
            if not data:
                raise ConnectionResetError("the controller has hung up")
            if len(data) >= HEADER.size:
                size = 6 + int.from_bytes(data[4:6], "big")
                if not HEADER.size < size <= LONGEST:
                    raise InvalidStateError(f"found an answer of {size} bytes")
                if len(data) >= size:
                    return data
            left = until - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            self._link.settimeout(left)
            more = self._link.recv(LONGEST)
            data = data + more if more else b""


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


def read_registers(answer: bytes, function: int, count: int) -> tuple[int, ...]:
    """Return the registers that an answer to 3, 4 or 23 holds. Raises InvalidStateError."""
    _check(answer, function)
    if len(answer) != 2 + 2 * count or answer[1] != 2 * count:
        raise InvalidStateError(f"found {(len(answer) - 2) // 2} registers, expected {count}")
    return struct.unpack_from(f">{count}H", answer, 2)


def check_written(answer: bytes, first: int, count: int) -> None:
    """Refuse an answer that does not confirm function 16. Raises InvalidStateError."""
    _check(answer, 16)
    if answer != SPAN.pack(16, first, count):
        raise InvalidStateError(f"found {answer[1:].hex(' ')} as the answer to a write")


def _check(answer: bytes, function: int) -> None:
    """Refuse a refusal, and an answer to another function."""
    found, code = [*answer[:2], 0, 0][:2]
    if found == function | REFUSED:
        raise InvalidStateError(refusal(code))
    if found != function:
        raise InvalidStateError(f"found an answer to function {found}, expected {function}")


def refusal(code: int) -> str:
    """Return what an exception code says."""
    return f"the controller refuses: {EXCEPTIONS.get(code, f'exception {code}')}"
