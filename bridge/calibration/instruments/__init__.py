"""What measures the tool; an explicit table of instruments."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, cast

if TYPE_CHECKING:
    from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, Surroundings
    from gapbridge.bridge.cell.settings.instruments import InstrumentSettings

_HERE = "gapbridge.bridge.calibration.instruments"
INSTRUMENTS: dict[str, str] = {
    "typed": f"{_HERE}.manual:Typed",
    "file": f"{_HERE}.file:File",
    "folder": f"{_HERE}.folder:WatchedFolder",
    "line_feed": f"{_HERE}.line_feed:LineFeed",
    "dial_gauge": f"{_HERE}.dial_gauge:DialGauge",
    "two_balls": f"{_HERE}.two_balls:TwoBalls",
    "sphere": f"{_HERE}.contact:Sphere",
    "point": f"{_HERE}.point:TipOnPoint",
    "simulated_tracker": f"{_HERE}.simulated_tracker:SimulatedTracker",
}
"""Name in a cell file (calibration.instrument.kind) -> ``module:Class``, imported on use."""


def make_instrument(settings: InstrumentSettings, around: Surroundings) -> AnyInstrument:
    """Return the instrument that the settings name, not yet open."""
    module, kind = INSTRUMENTS[settings.kind].split(":")
    found = getattr(importlib.import_module(module), kind)
    return cast("AnyInstrument", found(settings, around))
