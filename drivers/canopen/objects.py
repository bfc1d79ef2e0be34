"""Objects, modes and states of CiA 402 by their names in the standard."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Mode = Literal["cyclic synchronous position", "interpolated position"]
State = Literal[
    "NOT READY TO SWITCH ON", "SWITCH ON DISABLED", "READY TO SWITCH ON", "SWITCHED ON",
    "OPERATION ENABLED", "QUICK STOP ACTIVE", "FAULT REACTION ACTIVE", "FAULT",
]  # fmt: skip
FAULTS: tuple[State, ...] = ("FAULT REACTION ACTIVE", "FAULT")


@dataclass(frozen=True, slots=True)
class Address:
    """The address of an object in a drive's object dictionary."""

    index: int
    subindex: int

    def __str__(self) -> str:
        return f"0x{self.index:04X}" + (f":{self.subindex}" if self.subindex else "")


OBJECTS: dict[str, Address] = {
    "Error code": Address(0x603F, 0),
    "Controlword": Address(0x6040, 0),
    "Statusword": Address(0x6041, 0),
    "vl target velocity": Address(0x6042, 0),
    "Modes of operation": Address(0x6060, 0),
    "Modes of operation display": Address(0x6061, 0),
    "Position demand value": Address(0x6062, 0),
    "Position actual value": Address(0x6064, 0),
    "Velocity actual value": Address(0x606C, 0),
    "Target torque": Address(0x6071, 0),
    "Torque actual value": Address(0x6077, 0),
    "Current actual value": Address(0x6078, 0),
    "Target position": Address(0x607A, 0),
    "Profile velocity": Address(0x6081, 0),
    "Position offset": Address(0x60B0, 0),
    "Velocity offset": Address(0x60B1, 0),
    "Torque offset": Address(0x60B2, 0),
    "Interpolation data record": Address(0x60C1, 1),
    "Following error actual value": Address(0x60F4, 0),
    "Digital inputs": Address(0x60FD, 0),
    "Target velocity": Address(0x60FF, 0),
}
"""Object name -> its address. Others are written in profiles as 0x2001 or 0x2001:3."""

MODES: dict[Mode, tuple[int, str]] = {
    "interpolated position": (7, "Interpolation data record"),
    "cyclic synchronous position": (8, "Target position"),
}
"""Mode -> its number in Modes of operation, and the object that takes its setpoints."""

SYNC, NMT = 0x080, 0x000  # COB-IDs
HEARTBEAT_BASE, SDO_REQUEST_BASE = 0x700, 0x600
TPDO_BASE, RPDO_BASE, PDO_STEP, PDO_COUNT = 0x180, 0x200, 0x100, 4

ENABLE_INTERPOLATION = 0x10  # Controlword, interpolated position
MODE_ACTIVE = 0x1000  # Statusword bit 12: interpolation active; the drive follows the command

_MASKS: dict[State, tuple[int, int]] = {
    "NOT READY TO SWITCH ON": (0x4F, 0x00),
    "SWITCH ON DISABLED": (0x4F, 0x40),
    "READY TO SWITCH ON": (0x6F, 0x21),
    "SWITCHED ON": (0x6F, 0x23),
    "OPERATION ENABLED": (0x6F, 0x27),
    "QUICK STOP ACTIVE": (0x6F, 0x07),
    "FAULT REACTION ACTIVE": (0x4F, 0x0F),
    "FAULT": (0x4F, 0x08),
}

SHUTDOWN, SWITCH_ON, ENABLE_OPERATION = 0x06, 0x07, 0x0F
QUICK_STOP, DISABLE_VOLTAGE, FAULT_RESET = 0x02, 0x00, 0x80

TOWARDS_ENABLED: dict[State, int] = {
    "SWITCH ON DISABLED": SHUTDOWN,
    "READY TO SWITCH ON": SWITCH_ON,
    "SWITCHED ON": ENABLE_OPERATION,
    "OPERATION ENABLED": ENABLE_OPERATION,
    "QUICK STOP ACTIVE": DISABLE_VOLTAGE,
}
"""State -> the Controlword that leads one step nearer to OPERATION ENABLED."""


def state_of(statusword: int) -> State:
    """Return the state that a Statusword reports; an undefined one counts as a fault."""
    for state, (mask, bits) in _MASKS.items():
        if statusword & mask == bits:
            return state
    return "FAULT"
