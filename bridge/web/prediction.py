"""The wrench that the model expects at the flange sensor, beside what the sensor says."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.core.dynamics import predict_wrench
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

Array = NDArray[np.float64]


class WrenchPrediction:
    """Predicts for rows of the shared page, in this process and never in the loop's.

    Accelerations are left out: what is predicted is the weight of the payload and the pull of the
    surroundings on the tool. The model is read in a thread of its own, which takes a moment; until
    then, and where it cannot be read, predictions are NaN.
    """

    def __init__(self, settings: DaemonSettings, slices: Mapping[str, slice]) -> None:
        self._settings, self._slices = settings, slices
        self._model: Model | None = None
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        module, function = self._settings.model_source.split(":")
        try:
            model = getattr(importlib.import_module(module), function)(self._settings.cell).model
            n = model.arm.n
            self._predict(model, np.zeros((1, n)), Loads())  # compiled before it is needed
        except (GapbridgeError, ValueError, AttributeError, ImportError):
            return
        self._model = model

    def of(self, rows: Array) -> Array:
        """Return the wrenches (k, 6), N and Nm, flange axes, for rows (k, width)."""
        nothing = np.full((len(rows), 6), np.nan)
        s, model = self._slices, self._model
        if model is None or not len(rows) or np.isnan(rows[:, s["ft_raw_wrench"]]).all():
            return nothing
        mass, cog = rows[:, s["payload"].start], rows[:, s["payload_cog"]]
        temperature = rows[:, s["joint_temperatures"]]
        declared = bool(np.isfinite(mass).all() and np.isfinite(cog).all())
        force = rows[:, s["actual_TCP_force"]]
        loads = Loads(
            payload_mass=mass if declared else None,
            payload_cog=cog if declared else None,
            wrench=force if np.isfinite(force).all() else None,
            temperature=temperature if np.isfinite(temperature).all() else None,
        )
        q = rows[:, s["actual_q"]]
        if not np.isfinite(q).all():
            return nothing
        try:
            return self._predict(model, q, loads)
        except GapbridgeError:  # no equilibrium under this load
            return nothing

    @staticmethod
    def _predict(model: Model, q: Array, loads: Loads) -> Array:
        count, n = q.shape
        still = np.zeros((count, n))
        motion = Motion(
            t=np.zeros(count), q=q, qd=still, qdd=still, target_q=None, loads=loads,
            rows=np.arange(count), valid=np.ones(count, dtype=bool),
            stretch=np.zeros(count, dtype=np.int64), start=0.0, moving=False, still=np.zeros(n),
        )  # fmt: skip
        return predict_wrench(model, motion)
