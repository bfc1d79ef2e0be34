"""The arms of the evidence: DH rows as UR publishes them, and a seven-joint arm of usual size."""

from __future__ import annotations

import numpy as np
import yaml

from benchmarks.evidence import ROOT

SEVEN = [
    {"a": 0.0, "alpha": -np.pi / 2, "d": 0.34, "mass": 4.0, "cog": [0, 0.1, 0.03]},
    {"a": 0.0, "alpha": np.pi / 2, "d": 0.0, "mass": 4.1, "cog": [0.01, 0.06, 0.04]},
    {"a": 0.04, "alpha": np.pi / 2, "d": 0.4, "mass": 3.0, "cog": [0, 0.03, 0.12]},
    {"a": -0.04, "alpha": -np.pi / 2, "d": 0.0, "mass": 2.7, "cog": [0, 0.07, 0]},
    {"a": 0.0, "alpha": -np.pi / 2, "d": 0.4, "mass": 1.7, "cog": [0.02, 0, 0.1]},
    {"a": 0.01, "alpha": np.pi / 2, "d": 0.0, "mass": 1.8, "cog": [0, 0.01, 0.01]},
    {"a": 0.0, "alpha": 0.0, "d": 0.126, "mass": 0.3, "cog": [0, 0, 0.02]},
]


def dh_rows(name: str) -> list[dict]:
    """Return the DH rows of an arm: ``seven`` or a built-in one."""
    if name == "seven":
        return SEVEN
    text = (ROOT / "core" / "arms" / f"{name}.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)["dh"]
