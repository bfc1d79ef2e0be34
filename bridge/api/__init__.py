"""The Python interface: the commands as functions that return small records.

``import gapbridge`` provides the same names.
"""

from gapbridge.bridge.api.functions import compensate, diagnose, fit, load_cell, predict, read_log
from gapbridge.bridge.api.records import Corrected, Diagnosed, Fitted, Predicted
from gapbridge.bridge.cell import Cell
from gapbridge.core.errors import GapbridgeError, InputError
from gapbridge.core.log.log import Log

__all__ = [
    "Cell",
    "Corrected",
    "Diagnosed",
    "Fitted",
    "GapbridgeError",
    "InputError",
    "Log",
    "Predicted",
    "compensate",
    "diagnose",
    "fit",
    "load_cell",
    "predict",
    "read_log",
]
