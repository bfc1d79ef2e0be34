"""The model's prediction for the page: the flange sensor's wrench, and the deflected arm."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.document.drawing import EDGE
from gapbridge.bridge.document.scene import Path, Scene, base
from gapbridge.bridge.document.skeleton import reach, round_factor, skeleton
from gapbridge.core.arrays import Array
from gapbridge.core.dynamics import predict_wrench
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.files import recorded
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.motion import Motion

DRAWN = 0.15  # of the reach: drawn deflection of the stretched arm


class Prediction:
    """Predicts for rows of the shared memory, in this process, not in the loop's.

    The model is read in a thread; until it is ready, if it cannot be read, and if a file of it was
    edited after the daemon had read it, there is no prediction. ``digests``: SHA-256 of the files
    in use, by absolute path; None: whatever the disk holds.
    """

    def __init__(
        self,
        settings: DaemonSettings,
        slices: Mapping[str, slice],
        digests: Mapping[str, str] | None = None,
    ) -> None:
        self._settings, self._slices, self._digests = settings, slices, digests
        self._model: Model | None = None
        self._factor = 1.0  # by which the deflection is magnified in the drawing
        self.reading = threading.Thread(target=self._read, daemon=True)
        self.reading.start()

    def _read(self) -> None:
        try:
            with recorded() as files:
                model = resolve_name(self._settings.model_source)(self._settings.cell).model
            if not self._are_in_use(files):
                return
            # compiles before the first use
            q = np.zeros(model.arm.n)
            predict_wrench(model, Motion.at_rest(q[None], Loads()))
            bend = np.linalg.norm(skeleton(model, q)[-1] - skeleton(model.without_terms(), q)[-1])
        except (GapbridgeError, ValueError, AttributeError, ImportError):
            return
        self._factor = round_factor(DRAWN * reach(model) / max(float(bend), 1e-5))
        self._model = model

    def _are_in_use(self, files: Mapping[str, bytes]) -> bool:
        """Return whether the daemon has read the same files, by absolute path."""
        found = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
        return self._digests is None or found.items() <= self._digests.items()

    def arm(self, row: Array) -> dict[str, Any] | None:
        """Return the arm at a row (width,): joints, TCP, load and a drawing; None: unknown."""
        s, model = self._slices, self._model
        q = row[s["actual_q"]]
        if model is None or not np.isfinite(q).all():
            return None
        loads = self._loads(row[None])
        try:
            rigid = skeleton(model.without_terms(), q)
            tcp = model.predict(q[None], loads)
            bent = skeleton(model, q, loads)
        except GapbridgeError:  # no equilibrium under this load, or another arm
            return None
        declared = loads.payload_mass is not None
        pull = row[s["actual_TCP_force"]]
        return {
            "q": q.tolist(),
            "temperature": row[s["joint_temperatures"]].tolist(),
            "tcp": tcp.position[0].tolist(),
            "rotation": tcp.rotation_vector[0].tolist(),
            "bend": float(np.linalg.norm(bent[-1] - rigid[-1])),
            "factor": self._factor,
            "mass": float(row[s["payload"].start] if declared else model.payload_mass),
            "cog": (row[s["payload_cog"]] if declared else np.asarray(model.payload_cog)).tolist(),
            "declared": declared,
            "force": float(np.linalg.norm(pull[:3])),
            "scene": self._scene(model, rigid, rigid + self._factor * (bent - rigid),
                                 tcp.rotation[0]).document(),
        }  # fmt: skip

    @staticmethod
    def _scene(model: Model, rigid: Array, bent: Array, tool_in_base: Array) -> Scene:
        length = 0.1 * reach(model)
        axes = [
            Path(np.array([bent[-1], bent[-1] + length * tool_in_base[:, i]]), name, 3.0)
            for i, name in enumerate("xyz")
        ]
        arm = (Path(rigid, EDGE, 6.0, dots=True), Path(bent, "bar", 3.5, dots=True), *axes)
        return Scene("The arm", (*base(reach(model)), *arm))

    def wrenches(self, rows: Array) -> Array:
        """Return the wrenches (k, 6), N and Nm, flange axes, for rows (k, width).

        Static: the weight of the payload and the force of the surroundings on the tool, without
        inertia; NaN if there is no prediction.
        """
        nothing = np.full((len(rows), 6), np.nan)
        s, model = self._slices, self._model
        if model is None or not len(rows) or np.isnan(rows[:, s["ft_raw_wrench"]]).all():
            return nothing
        loads = self._loads(rows)
        q = rows[:, s["actual_q"]]
        if not np.isfinite(q).all():
            return nothing
        try:
            return predict_wrench(model, Motion.at_rest(q, loads))
        except GapbridgeError:  # no equilibrium under this load
            return nothing

    def _loads(self, rows: Array) -> Loads:
        s = self._slices
        mass, cog = rows[:, s["payload"].start], rows[:, s["payload_cog"]]
        temperature, force = rows[:, s["joint_temperatures"]], rows[:, s["actual_TCP_force"]]
        declared = bool(np.isfinite(mass).all() and np.isfinite(cog).all())
        return Loads(
            payload_mass=mass if declared else None,
            payload_cog=cog if declared else None,
            wrench=force if np.isfinite(force).all() else None,
            temperature=temperature if np.isfinite(temperature).all() else None,
        )
