"""Units that a DBC or a profile may use, and what one of them is in SI."""

from __future__ import annotations

import math

TURN = 2.0 * math.pi
DEGREE = math.pi / 180.0

UNITS: dict[str, dict[str, float]] = {
    "position": {
        "rad": 1.0, "mrad": 1e-3, "deg": DEGREE, "°": DEGREE, "mdeg": 1e-3 * DEGREE,
        "turn": TURN, "turns": TURN, "rev": TURN,
    },
    "velocity": {
        "rad/s": 1.0, "mrad/s": 1e-3, "deg/s": DEGREE, "°/s": DEGREE, "mdeg/s": 1e-3 * DEGREE,
        "turn/s": TURN, "turns/s": TURN, "rev/s": TURN, "rpm": TURN / 60.0,
    },
    "torque": {"Nm": 1.0, "N.m": 1.0, "mNm": 1e-3},
    "temperature": {"degC": 1.0, "°C": 1.0, "C": 1.0},
}  # fmt: skip
"""Quantity -> unit -> rad, rad/s, Nm or °C in one of it."""
