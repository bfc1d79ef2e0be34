"""Instruments without a value of their own: contact with a fixed object, the flange sensor."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    ReadRequest,
    S,
    Samples,
)
from gapbridge.bridge.cell.settings.instruments import Base, PointSettings, SphereSettings

NO_VALUES = np.zeros((1, 0))


class _Contact(Instrument[S]):
    """The operator brings the tool into contact and confirms; the joint angles are the reading."""

    self_triggered = True
    contact = True
    question: str

    def read(self, request: ReadRequest) -> Samples:
        """Return one empty sample (1, 0) once contact is confirmed. Raises ReadingError."""
        if answer := self.context.ask(f"{self.question}? Enter"):
            raise ReadingError(f"found {answer!r}, expected Enter")
        return Samples(NO_VALUES)


class SphereContact(_Contact[SphereSettings]):
    """The tool's probe in contact with a fixed sphere."""

    name, placed_part = "probe on a fixed sphere", "the sphere"
    question = "probe seated on the sphere"


class PointContact(_Contact[PointSettings]):
    """The tool's tip on one fixed point."""

    name, placed_part, question = "tip on a fixed point", "the point", "tip on the point"


class FlangeSensor(Instrument[Base]):
    """The flange's force-torque sensor: the controller reports its wrench with the joints."""

    self_triggered = True
    needs_wrench = True
    kind = "wrench"
    name = "the flange's force sensor"

    def read(self, request: ReadRequest) -> Samples:
        """Return one empty sample (1, 0): the wrench is part of the joint sample."""
        return Samples(NO_VALUES)
