"""The one error tree of Gapbridge.

::

    GapbridgeError
    ├── InputError            the user's input cannot be used: exit 2, one clear line
    │   ├── ArmError          an arm table, URDF or DH list
    │   ├── CellError         a cell file
    │   ├── LogError          a log or a trajectory
    │   │   └── LogOptionError   a source whose conversion needs another option
    │   ├── EquilibriumError  a load under which the model's arm would buckle
    │   ├── ExcitationError   the data do not determine what was requested
    │   └── PlanError         no poses can be planned for the request
    └── RunError              something failed while running: exit 1, one clear line
        ├── LinkError         a controller cannot be reached, or broke off
        │   ├── StaleStateError     no fresh state in time
        │   ├── InvalidStateError   a state that is torn, not finite or implausible
        │   └── WriteError          a setpoint could not be delivered
        │       ├── PartialWriteError       only a part was sent; the next one is sent whole
        │       ├── IneffectiveWriteError   it was sent and had no effect
        │       ├── ForeignCommandError     somebody else commands the arm
        │       └── GateError               the gate before the wire refused it: nothing was sent
        ├── VerificationError a verification that did not pass
        └── LimitError        a setpoint outside the limits, not sent
"""

from __future__ import annotations

import errno
from collections.abc import Sequence
from enum import StrEnum

Keys = Sequence[str | int]  # of a YAML file, from its top level; an index of a list from 0


class GapbridgeError(Exception):
    """Base of all errors that Gapbridge raises."""

    exit_code = 1


class InputError(GapbridgeError):
    """The user's input cannot be used; the message names file, key or row, found and expected.

    ``keys`` are those of the cell file that the error is of, and begin its message; the caller who
    has the file adds its name and the line. None: the message names its place itself.
    """

    exit_code = 2

    def __init__(self, message: str, keys: Keys | None = None) -> None:
        super().__init__(message if keys is None else f"{key_path(keys)}: {message}")
        self.message = message
        self.keys = keys


class ArmError(InputError):
    """An arm description (table, URDF, DH rows) cannot be used."""


class CellError(InputError):
    """A cell file cannot be used."""


class LogError(InputError):
    """A log or a trajectory file cannot be used."""


class LogOptionError(LogError):
    """A source needs an option of its conversion, or another value of one."""


class EquilibriumError(InputError):
    """The arm has no equilibrium under its load in one row of several."""

    text = "the arm finds no equilibrium under its load; expected smaller flexibilities or loads"

    def __init__(self, row: int) -> None:
        super().__init__(f"row {row + 1}: {self.text}")
        self.row = row  # from 0


class ExcitationError(InputError):
    """The data do not determine what was requested; the message names what is missing."""


class PlanError(InputError):
    """No poses can be planned for the request; the message names the reason."""


class RunError(GapbridgeError):
    """Something failed at run time."""


class VerificationError(RunError):
    """The readings of a verification do not fit the calibration."""


class LinkError(RunError):
    """A controller cannot be reached, or the link to it broke."""


class StaleStateError(LinkError):
    """The controller's own clock stood still for longer than allowed."""


class Implausible(StrEnum):
    """Why a state was rejected; metrics and events have these names."""

    TORN = "torn"  # or of the wrong length, or a wrong answer
    NOT_FINITE = "not_finite"
    VALUE = "implausible"  # out of the bounds of what an arm can have
    STEP = "step"  # joints that cannot have moved that far
    BACKWARDS = "backwards"  # the controller's clock


class InvalidStateError(LinkError):
    """A state that is torn, not finite, of the wrong length or implausible."""

    def __init__(self, message: str, reason: Implausible = Implausible.TORN) -> None:
        super().__init__(message)
        self.reason = reason


class WriteError(LinkError):
    """A setpoint could not be delivered, or the controller refused it."""


class PartialWriteError(WriteError):
    """Only a part of a setpoint was sent, the link is up: the next one may be sent, whole."""


class RobotBusyError(WriteError):
    """The robot is still on its way to the last target: nothing of this setpoint was sent."""


class LateSetpointError(RobotBusyError):
    """A setpoint of several messages took too long: its last message was not sent."""


class IneffectiveWriteError(WriteError):
    """Setpoints were sent without effect, though the link is up."""


class ForeignCommandError(WriteError):
    """Somebody else commands the arm: two masters, expected one."""


class GateError(WriteError):
    """The last check before the wire refused a setpoint; nothing of it was sent."""


class LimitError(RunError):
    """A setpoint that is not sent: not finite, or outside its limits."""


def key_path(keys: Keys) -> str:
    """Return a key path for messages: ``robot.dh entry 2.a``, list entries from 1."""
    text = ""
    for key in keys:
        if isinstance(key, int):
            text += f" entry {key + 1}"
        else:
            text += f"{'.' if text else ''}{key}"
    return text


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, or its type."""
    if isinstance(error, OSError) and error.errno in errno.errorcode:
        return error.strerror or type(error).__name__
    lines = str(error).strip().splitlines()
    return lines[0].strip() if lines else type(error).__name__
