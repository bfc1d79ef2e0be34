"""What the library gives as an answer, checked: it takes nearly anything for one."""

from __future__ import annotations

from typing import Any

from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.modbus.registers import wire_of

EXCEPTIONS = {
    1: "illegal function", 2: "illegal address", 3: "illegal value", 4: "device failure",
    5: "acknowledge", 6: "device busy", 10: "no path to the device",
    11: "the device does not answer",
}  # fmt: skip
"""Exception codes (MODBUS Application Protocol Specification V1.1b3, 7)."""


def check_answer(answer: Any, function: int, count: int, where: str) -> bytes:
    """Return the registers or bits of an answer, two bytes each.

    Raises InvalidStateError where it is not one.
    """
    _check_function(answer, function, where)
    found = answer.bits[:count] if function in (1, 2) else answer.registers
    if len(found) != count:
        raise InvalidStateError(f"{where}: found {len(found)} registers, expected {count}")
    if function in (1, 2):
        return wire_of([int(v) for v in found])
    if min(found) < 0 or max(found) > 0xFFFF:
        raise InvalidStateError(f"{where}: found a register beyond 16 bits")
    return wire_of(found)


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
