"""What measures the tool; an explicit table of instruments."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import yaml
from pydantic import TypeAdapter, ValidationError

from gapbridge.bridge.calibration.instruments.files import File, WatchedFolder
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument
from gapbridge.bridge.calibration.instruments.joints_alone import Sphere, TipOnPoint
from gapbridge.bridge.calibration.instruments.over_tcp import LineFeed, SimulatedTracker
from gapbridge.bridge.calibration.instruments.typed import DialGauge, TwoBalls, Typed
from gapbridge.bridge.cell.settings.instruments import InstrumentSettings
from gapbridge.core.errors import InputError

if TYPE_CHECKING:
    from gapbridge.bridge.cell import Cell

INSTRUMENTS: dict[str, type[AnyInstrument]] = {
    "typed": Typed,
    "file": File,
    "folder": WatchedFolder,
    "line_feed": LineFeed,
    "dial_gauge": DialGauge,
    "two_balls": TwoBalls,
    "sphere": Sphere,
    "point": TipOnPoint,
    "simulated_tracker": SimulatedTracker,
}
"""By the name in a cell file (calibration.instrument.kind)."""
_SETTINGS: TypeAdapter[InstrumentSettings] = TypeAdapter(InstrumentSettings)


def instrument_settings(cell: Cell, given: str | None) -> InstrumentSettings:
    """Return the settings of an instrument given as ``KIND[,KEY=VALUE...]``; None: the cell's.

    Keys that are left out come from the cell where it has the same kind. Paths are relative to the
    working folder. Raises InputError.
    """
    own = cell.calibration.instrument
    if given is None:
        return own
    kind, *pairs = (part.strip() for part in given.split(","))
    if kind not in INSTRUMENTS:
        raise InputError(f"--instrument: found {kind!r}, expected one of {', '.join(INSTRUMENTS)}")
    keys: dict[str, Any] = own.model_dump() if own.kind == kind else {}
    keys["kind"] = kind
    for pair in pairs:
        name, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"--instrument: found {pair!r}, expected KEY=VALUE")
        keys[name.strip()] = yaml.safe_load(value)
    try:
        return _SETTINGS.validate_python(keys)
    except ValidationError as error:
        worst = error.errors()[0]
        name = ".".join(str(part) for part in worst["loc"][1:])
        message = str(worst["msg"]).removeprefix("Value error, ")
        raise InputError(
            f"--instrument {kind}: {name}: {message[:1].lower()}{message[1:]}"
        ) from None
