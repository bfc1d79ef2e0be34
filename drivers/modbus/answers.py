"""What the library gives as an answer, checked: it takes nearly anything for one."""

from __future__ import annotations

from typing import Any

from gapbridge.core.errors import InvalidStateError
from gapbridge.drivers.modbus.registers import wire_of
from gapbridge.drivers.modbus.tcp_requests import refusal


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


def check_written(answer: Any, function: int, address: int, where: str) -> None:
    """Refuse an answer that does not confirm a write. Raises InvalidStateError."""
    _check_function(answer, function, where)
    if answer.address != address:
        raise InvalidStateError(f"{where}: found address {answer.address}, expected {address}")


def _check_function(answer: Any, function: int, where: str) -> None:
    if answer is None:
        raise InvalidStateError(f"{where}: found no answer")
    if answer.isError():
        raise InvalidStateError(f"{where}: {refusal(getattr(answer, 'exception_code', 0))}")
    if answer.function_code != function:
        raise InvalidStateError(
            f"{where}: found an answer to function {answer.function_code}, expected {function}"
        )
