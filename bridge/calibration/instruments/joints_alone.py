"""Readings without a number: the tool brought onto something fixed, or the flange's sensor."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import (
    Instrument,
    ReadingError,
    S,
    Samples,
    Where,
)
from gapbridge.bridge.cell.settings.instruments import Base, PointSettings, SphereSettings

NO_NUMBER = np.zeros((1, 0))


class _Seated(Instrument[S]):
    """A person brings the tool onto something fixed and says so; no metrology at all."""

    waits = True
    seats = True
    question: str

    def read(self, where: Where) -> Samples:
        """Return one sample without any number (1, 0), once the tool is seated."""
        if answer := self.around.ask(f"{self.question}? Enter"):
            raise ReadingError(f"found {answer!r}, expected Enter")
        return Samples(NO_NUMBER)


class Sphere(_Seated[SphereSettings]):
    """The tool's probe on a fixed sphere."""

    stands, name, question = "the sphere", "probe on a fixed sphere", "probe seated on the sphere"


class TipOnPoint(_Seated[PointSettings]):
    """The tool's tip on one fixed point."""

    stands, name, question = "the point", "tip on a fixed point", "tip on the point"


class FlangeSensor(Instrument[Base]):
    """The force sensor in the flange: the controller reports its reading beside the joints."""

    waits = True
    needs_wrench = True
    kind = "wrench"
    name = "the flange's force sensor"

    def read(self, where: Where) -> Samples:
        """Return no number (1, 0): the wrench stands beside the joints."""
        return Samples(NO_NUMBER)
