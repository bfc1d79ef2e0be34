"""The driver in a process of its own: its library can hang, abort or crash the one it is in."""

from __future__ import annotations

import sys
import textwrap
from pathlib import Path
from typing import Any

TESTS = Path(__file__).resolve().parents[2]
PLACES = [str(TESTS / "drivers" / "simulated"), str(TESTS)]
sys.path[:0] = PLACES

from patience import PATIENCE  # noqa: E402
from simulated_cell import Bench, cell_settings, run_client  # noqa: E402

from benchmarks.server_thread import OFFSET_SCRIPT  # noqa: E402

__all__ = ["Bench", "cell_settings", "run_driver"]

PREAMBLE = """
import sys
sys.path[:0] = {places!r}
import numpy as np
from simulated_cell import Bench
from gapbridge.core.arm import builtin_arm
from gapbridge.core.errors import *
from gapbridge.core.model import Model
from gapbridge.core.state import Setpoint
from gapbridge.drivers import make_driver
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

model = Model(builtin_arm("ur10e"))
driver = make_driver(UrRtdeSettings(host=host, **{link!r}), model)
bench = Bench(host)

def setpoint(state, q, nominal_q, offset=np.zeros(6)):
    return Setpoint(q, nominal_q, offset)

def error_of(action, *arguments):
    try:
        action(*arguments)
    except GapbridgeError as error:
        return type(error).__name__ + ": " + str(error)
    return ""

def until_error(seconds):
    begun = time.monotonic()
    while time.monotonic() - begun < seconds:
        found = error_of(driver.read_state)
        if found:
            return found, time.monotonic() - begun
    return "", seconds

def read_state():
    for _ in range(1000):  # a busy machine may read slower than samples come: that is refused
        try:
            return driver.read_state()
        except InvalidStateError:
            pass
    raise AssertionError("no whole sample in 1000 readings")

def read_for(cycles):
    for _ in range(cycles):
        state = read_state()
    return state
"""


def run_driver(host: str, body: str, timeout: float = 2 * PATIENCE, **link: Any) -> dict[str, Any]:
    """Run ``body`` with a driver, a bench and a few words; returns what it puts into ``out``."""
    link.setdefault("state_timeout", 1.0)  # a busy machine holds the simulated controller up
    preamble = PREAMBLE.format(places=PLACES, link=link)
    return run_client(host, preamble + textwrap.dedent(body), timeout)


def offset_program() -> str:
    """Return the program that users load onto their robot."""
    return OFFSET_SCRIPT.read_text(encoding="utf-8")
