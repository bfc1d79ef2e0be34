"""Instruments that measure the tool, in an explicit table."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import yaml
from pydantic import ValidationError

from gapbridge.bridge.calibration.instruments.files import ReadingsFile, WatchedFolder
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument
from gapbridge.bridge.calibration.instruments.joint_only import PointContact, SphereContact
from gapbridge.bridge.calibration.instruments.network import LineFeed, SimulatedTracker
from gapbridge.bridge.calibration.instruments.typed import DialGauge, TwoBalls, TypedCoordinates
from gapbridge.bridge.cell.message import validation_errors
from gapbridge.bridge.cell.schema import CellFile
from gapbridge.bridge.cell.settings.instruments import InstrumentSettings
from gapbridge.core.errors import InputError

if TYPE_CHECKING:
    from gapbridge.bridge.cell import Cell

INSTRUMENTS: dict[str, type[AnyInstrument]] = {
    "typed": TypedCoordinates,
    "file": ReadingsFile,
    "folder": WatchedFolder,
    "line_feed": LineFeed,
    "dial_gauge": DialGauge,
    "two_balls": TwoBalls,
    "sphere": SphereContact,
    "point": PointContact,
    "simulated_tracker": SimulatedTracker,
}
"""calibration.instrument.kind in a cell file -> class."""
SECTION = "calibration"


def _plain(pair: str, value: str) -> Any:
    """Return a value of the command line. Raises InputError."""
    try:
        return yaml.safe_load(value)
    except (yaml.YAMLError, ValueError, LookupError, AttributeError, TypeError):  # !!int of a text
        expected = "expected KEY=VALUE in YAML (signs in quotes)"
        raise InputError(f"--instrument: found {pair!r}, {expected}") from None


def instrument_settings(cell: Cell, argument: str | None) -> InstrumentSettings:
    """Return the settings of an instrument given as ``KIND[,KEY=VALUE...]``; None: the cell's.

    Omitted keys are taken from the cell if it has the same kind. Paths are relative to the working
    folder. Raises InputError.
    """
    settings = cell.calibration.instrument
    if argument is None:
        return settings
    kind, *pairs = (part.strip() for part in re.split(r",(?![^\[]*\])", argument))
    if kind not in INSTRUMENTS:
        raise InputError(f"--instrument: found {kind!r}, expected one of {', '.join(INSTRUMENTS)}")
    given: dict[str, Any] = {"kind": kind}
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--instrument: found {pair!r}, expected KEY=VALUE")
        if name.strip() in given:
            raise InputError(f"--instrument: found {name.strip()} twice, expected it once")
        given[name.strip()] = _plain(pair, value)
    keys = settings.model_dump() | given if settings.kind == kind else given
    sections = {"robot": {"model": "ur10e"}, SECTION: {"instrument": keys}}
    try:
        return CellFile.model_validate(sections).calibration.instrument
    except ValidationError as error:
        text = validation_errors(CellFile, error)[0][1]
        raise InputError(
            f"--instrument {kind}: {text.removeprefix(f'{SECTION}.instrument.')}"
        ) from None
