"""Gapbridge: stiffness model of a robot arm, setpoint compensation, sim-to-real diagnosis.

The names below are the public interface. They are imported on first use, so that
``import gapbridge`` is quick. Everything else may change.

Example::

    import gapbridge

    cell = gapbridge.load_cell("cell.yaml")
    poses = gapbridge.predict(cell, gapbridge.read_log("log.csv", cell))
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gapbridge.bridge.api import Cell as Cell
    from gapbridge.bridge.api import Corrected as Corrected
    from gapbridge.bridge.api import Diagnosed as Diagnosed
    from gapbridge.bridge.api import Fitted as Fitted
    from gapbridge.bridge.api import GapbridgeError as GapbridgeError
    from gapbridge.bridge.api import InputError as InputError
    from gapbridge.bridge.api import Log as Log
    from gapbridge.bridge.api import Predicted as Predicted
    from gapbridge.bridge.api import compensate as compensate
    from gapbridge.bridge.api import diagnose as diagnose
    from gapbridge.bridge.api import fit as fit
    from gapbridge.bridge.api import load_cell as load_cell
    from gapbridge.bridge.api import predict as predict
    from gapbridge.bridge.api import read_log as read_log
    from gapbridge.core.arm import Arm as Arm
    from gapbridge.core.arm import builtin_arm as builtin_arm
    from gapbridge.core.compensation import Compensator as Compensator
    from gapbridge.core.loads import Loads as Loads
    from gapbridge.core.model import Model as Model
    from gapbridge.core.state import RobotState as RobotState
    from gapbridge.core.state import Setpoint as Setpoint
    from gapbridge.drivers import make_driver as make_driver
    from gapbridge.drivers.driver import Driver as Driver

API = (
    "Cell", "Corrected", "Diagnosed", "Fitted", "GapbridgeError", "InputError", "Log", "Predicted",
    "compensate", "diagnose", "fit", "load_cell", "predict", "read_log",
)  # fmt: skip
PUBLIC: dict[str, str] = dict.fromkeys(API, "bridge.api") | {
    "Arm": "core.arm",
    "Compensator": "core.compensation",
    "Driver": "drivers.driver",
    "Loads": "core.loads",
    "Model": "core.model",
    "RobotState": "core.state",
    "Setpoint": "core.state",
    "builtin_arm": "core.arm",
    "make_driver": "drivers",
}
"""Public name -> module below this package."""


def __getattr__(name: str) -> Any:
    """Import and return a public name."""
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{PUBLIC[name]}"), name)


def __dir__() -> list[str]:
    """Return the public names."""
    return sorted(PUBLIC)
