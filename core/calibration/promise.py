"""What a calibration promises, as a document that is kept beside the cell for later checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.calibration.redundancy import Redundancy
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.errors import InputError
from gapbridge.core.model import Model

Array = NDArray[np.float64]
SCHEMA = "gapbridge.calibration/1"


@dataclass(frozen=True)
class Promise:
    """How far off a calibrated model may be, and how noisy its readings were."""

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
        """Return the same parameters, to be found beyond ``model`` (the calibrated one)."""
        every = Parameters.every(model, effects_of(self.names))
        at = {name: i for i, name in enumerate(every.names)}
        missing = [name for name in self.names if name not in at]
        if missing:
            raise InputError(
                f"calibration: found parameter {missing[0]!r}, expected one of this cell's arm"
            )
        return every.part(Redundancy([at[name] for name in self.names], ()))


def effects_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return the effects that parameters with these names belong to, each once."""
    found = []
    for name in names:
        fitting = [e for e in CATALOGUE if name == e or name.startswith(f"{e}_")]
        if not fitting:
            raise InputError(f"calibration: found parameter {name!r}, expected one of an effect")
        found.append(max(fitting, key=len))
    return tuple(dict.fromkeys(found))


def document_of(calibration: Calibration, sigma: float = float("nan")) -> dict[str, Any]:
    """Return the promise of a calibration as plain data, for JSON.

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
        "verdict": calibration.verdict,
    }


def promise_in(document: Mapping[str, Any], where: str = "calibration") -> Promise:
    """Return the promise that a document holds; raises InputError naming what is wrong with it."""
    if document.get("schema") != SCHEMA:
        raise InputError(f"{where}: schema: found {document.get('schema')!r}, expected {SCHEMA!r}")
    try:
        parameters, noise = document["parameters"], document["noise"]
        names = tuple(str(p["name"]) for p in parameters)
        covariance = np.array(document["covariance"], dtype=float).reshape(len(names), len(names))
        return Promise(
            str(document["kind"]), names, np.array([float(p["value"]) for p in parameters]),
            covariance, _number(noise["sigma"]), _number(noise["instrument"]),
            _number(noise["turn"]), _number(noise["joint"]),
            _number(document["freedom"], np.inf), _number(document["rms"]),
        )  # fmt: skip
    except KeyError as error:
        raise InputError(f"{where}: key {error.args[0]!r}: not found, expected it") from None
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: found something unusable ({error})") from None


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _number(value: float | None, missing: float = float("nan")) -> float:
    return missing if value is None else float(value)
