"""The accuracy of a calibration, as a document stored next to the cell for later verification."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.spread import parameters_named
from gapbridge.core.errors import InputError
from gapbridge.core.model import Model

SCHEMA = "gapbridge.calibration/1"


@dataclass(frozen=True)
class AccuracyBaseline:
    """Covariance of a calibrated model's parameters, and the noise of its readings."""

    kind: str  # of the readings
    names: tuple[str, ...]  # of the parameters
    values: Array  # (p,)
    covariance: Array  # (p, p)
    sigma: float  # m, as the instrument's data sheet had it; nan: unknown
    instrument: float  # m, 1 sigma of one coordinate, the instrument alone
    turn: float  # rad, of a measured rotation; nan: none
    joint: float  # rad, 1 sigma of one joint's repeatability
    freedom: float
    rms: float  # m, of the held-out errors (of the fitted ones where none were held out)

    def parameters(self, model: Model) -> Parameters:
        """Return the same parameters, as corrections to ``model`` (the calibrated one)."""
        return parameters_named(model, self.names, "calibration")


def baseline_document(calibration: Calibration, sigma: float = float("nan")) -> dict[str, Any]:
    """Return the accuracy baseline of a calibration as plain data, for JSON.

    ``sigma`` (m) is the instrument's own, as the cell states it.
    """
    held = len(calibration.held_out_after.rows) > 0
    errors = calibration.held_out_after if held else calibration.after
    return {
        "schema": SCHEMA,
        "kind": calibration.readings.kind,
        "parameters": [
            {"name": e.name, "value": e.value, "std": e.std, "unit": e.unit, "shown": e.shown}
            for e in calibration.estimates
        ],
        "covariance": calibration.whole_covariance.tolist(),
        "noise": {
            "sigma": _plain(sigma),
            "instrument": _plain(calibration.instrument_noise),
            "turn": _plain(calibration.turn_noise),
            "joint": _plain(calibration.joint_noise),
        },
        "freedom": _plain(calibration.freedom),
        "rms": _plain(errors.rms),
        "held_out": held,
        "complete": calibration.complete,
    }


def read_baseline(document: Mapping[str, Any], where: str = "calibration") -> AccuracyBaseline:
    """Return the baseline in a document; raises InputError naming the key that is wrong."""
    if document.get("schema") != SCHEMA:
        raise InputError(f"{where}: schema: found {document.get('schema')!r}, expected {SCHEMA!r}")
    try:
        parameters, noise = document["parameters"], document["noise"]
        names = tuple(str(p["name"]) for p in parameters)
        covariance = np.array(document["covariance"], dtype=float).reshape(len(names), len(names))
        baseline = AccuracyBaseline(
            str(document["kind"]), names, np.array([float(p["value"]) for p in parameters]),
            covariance, _number(noise["sigma"]), _number(noise["instrument"]),
            _number(noise["turn"]), _number(noise["joint"]),
            _number(document["freedom"], np.inf), _number(document["rms"]),
        )  # fmt: skip
        _check_numbers(baseline)
    except KeyError as error:
        raise InputError(f"{where}: key {error.args[0]!r}: not found, expected it") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: found something unusable ({error})") from None
    return baseline


def _check_numbers(baseline: AccuracyBaseline) -> None:
    """Raise ValueError where nothing can be tested against the baseline's numbers."""
    covariance = baseline.covariance
    size = float(np.abs(covariance).max(initial=0.0))
    if not np.isfinite(size) or np.abs(covariance - covariance.T).max(initial=0.0) > 1e-6 * size:
        raise ValueError("covariance: expected finite numbers, symmetric")
    if np.linalg.eigvalsh(covariance).min(initial=0.0) < -1e-6 * size:
        raise ValueError("covariance: found a negative variance")
    if len(set(baseline.names)) < len(baseline.names):
        raise ValueError("parameters: found one twice")
    if baseline.instrument <= 0.0 or baseline.joint < 0.0 or not baseline.freedom > 0.0:
        raise ValueError("noise, freedom: expected numbers above 0")


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _number(value: float | None, missing: float = float("nan")) -> float:
    return missing if value is None else float(value)
