"""What may be asked of the robot library; anything else raises before the socket.

The control script that the library uploads can run any motion and set any output, and RTDE inputs
are anybody's: nothing of that leaves from here but what these lists name.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gapbridge.core.errors import WriteError
from gapbridge.drivers.ur_rtde import registers

CONTROL = (
    "setWatchdog", "kickWatchdog", "servoJ", "servoStop", "stopScript", "reuploadScript",
    "isConnected", "isProgramRunning",
)  # fmt: skip
DOUBLES = frozenset(registers.OFFSET_DOUBLES)
INTEGERS = frozenset(
    (
        registers.OFFSET_RZ,
        registers.SEQUENCE,
        registers.CHECKSUM,
        registers.HEARTBEAT,
        registers.RATES,
    )
)


class AllowedControl:
    """The library's control interface with the calls of CONTROL and no others."""

    def __init__(self, host: str, library: Any) -> None:
        self._host, self._library = host, library  # kept: its end is not safe
        for name in CONTROL:
            setattr(self, name, getattr(library, name))

    def __getattr__(self, name: str) -> Any:
        """Refuse every other call. Raises WriteError."""
        raise WriteError(f"{self._host}: {name}: is not among the calls that may be made")


class AllowedInputs:
    """The library's inputs with the registers of the offset and no others."""

    def __init__(self, host: str, library: Any) -> None:
        self._host, self._library = host, library
        self._double: Callable[[int, float], bool] = library.setInputDoubleRegister
        self._integer: Callable[[int, int], bool] = library.setInputIntRegister

    def setInputDoubleRegister(self, register: int, value: float) -> bool:
        """Write a double register. Raises WriteError for one that is not allowed."""
        if register not in DOUBLES:
            self._refuse("input_double_register", register)
        return self._double(register, value)

    def setInputIntRegister(self, register: int, value: int) -> bool:
        """Write an integer register. Raises WriteError for one that is not allowed."""
        if register not in INTEGERS:
            self._refuse("input_int_register", register)
        return self._integer(register, value)

    def _refuse(self, kind: str, register: int) -> None:
        raise WriteError(f"{self._host}: {kind}_{register}: is not among the registers written")
