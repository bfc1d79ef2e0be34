"""One stop: the instrument is read while the arm stands, and what it says is averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError, Where
from gapbridge.bridge.calibration.joints.joint_source import JointSource, Stand
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError
from gapbridge.core.rotation import rotation_matrix, rotation_vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Captured:
    """An averaged reading and where the arm stood meanwhile."""

    stand: Stand
    value: Array  # (k,) SI
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: one sample gives none
    spread: float  # m, 1 sigma of one coordinate of one sample; nan: as above
    samples: int
    source: str


def capture(
    instrument: AnyInstrument, joints: JointSource, pose: PlannedPose, stand: Stand | None,
    where: Where,
) -> Captured:  # fmt: skip
    """Read the instrument. Raises ReadingError where it fails or the arm moved meanwhile.

    ``stand`` None: the arm stands where it does once the instrument has been read.
    """
    found = instrument.read(where)
    if stand is None:
        stand = joints.stand(pose)
    elif not joints.still(stand):
        raise ReadingError("the arm moved while it was measured")
    if instrument.needs_wrench and stand.raw_wrench is None:
        raise LinkError("the controller sends no ft_raw_wrench, expected a force sensor's reading")
    values = found.values
    if not np.isfinite(values).all():
        raise ReadingError("found a reading that is not finite")
    spread = float("nan")
    if len(values) > 1 and values.shape[1]:
        lengths = values[:, :3] if values.shape[1] >= 3 else values
        spread = float(np.sqrt(lengths.var(axis=0, ddof=1).mean()))
    return Captured(
        stand, mean(values), spread / np.sqrt(len(values)), spread, len(values), found.source
    )


def mean(values: Array) -> Array:
    """Return the mean (k,) of samples (M, k); rotations as matrices, as near pi vectors flip."""
    found: Array = np.asarray(values.mean(axis=0), dtype=float)
    if values.shape[1] == 6:
        U, _, Vt = np.linalg.svd(rotation_matrix(values[:, 3:]).mean(axis=0))
        turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
        found[3:] = rotation_vector(turn)
    return found
