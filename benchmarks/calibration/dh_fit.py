"""What anybody would write first: scipy's least squares on the DH table, tool and frame along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.blind.mechanics import Array
from gapbridge.core.estimation.registration import register_robustly
from gapbridge.core.model import Model

LOOKS = 60  # residuals at most: columns that do the same let it wander for minutes


@dataclass(frozen=True)
class DhFit:
    """A fitted table: per row a, alpha, d, offset; then the tool's tip; then the frame."""

    values: Array  # (4n + 9,)

    @property
    def count(self) -> int:
        """Return the number of fitted numbers."""
        return len(self.values)

    def predict(self, q: Array) -> Array:
        """Return positions (N, 3) in the instrument's frame."""
        n = q.shape[1]
        rows = self.values[: 4 * n].reshape(n, 4)
        tool, frame = self.values[4 * n : 4 * n + 3], self.values[4 * n + 3 :]
        R = np.tile(Rotation.from_rotvec(frame[3:]).as_matrix(), (len(q), 1, 1))
        p = np.tile(frame[:3], (len(q), 1))
        for i, (a, alpha, d, offset) in enumerate(rows):
            c, s = np.cos(q[:, i] + offset), np.sin(q[:, i] + offset)
            ca, sa = np.cos(alpha), np.sin(alpha)
            zero, one = np.zeros_like(c), np.ones_like(c)
            step = np.stack([
                np.stack([c, -s * ca, s * sa], -1),
                np.stack([s, c * ca, -c * sa], -1),
                np.stack([zero, sa * one, ca * one], -1),
            ], axis=1)  # fmt: skip
            p = p + np.einsum("nij,nj->ni", R, np.stack([a * c, a * s, d * one], -1))
            R = R @ step
        return np.asarray(p + R @ tool)


def fit_dh(model: Model, q: Array, measured: Array) -> DhFit:
    """Return the fit that begins at the model's own table."""
    n = model.arm.n
    links = model.arm.link_in_link
    table = np.zeros((n, 4))
    for i in range(n):
        table[i, :3] = _row(links[i + 1])
        table[i, 3] = np.arctan2(-links[i][0, 1], links[i][0, 0])  # the zero stands before the row
    start = DhFit(np.concatenate([table.ravel(), model.tool_in_flange[:3, 3], np.zeros(6)]))
    frame = register_robustly(measured, start.predict(q))
    begin = start.values.copy()
    begin[-6:-3] = frame.position
    begin[-3:] = Rotation.from_matrix(frame.rotation).as_rotvec()

    def left(values: Array) -> Array:
        return np.asarray((DhFit(values).predict(q) - measured).ravel())

    found = least_squares(left, begin, x_scale="jac", method="trf", max_nfev=LOOKS)
    return DhFit(found.x)


def _row(link: Array) -> tuple[float, float, float]:
    """Return a, alpha, d of a link of a DH table: Tz(d) Tx(a) Rx(alpha), then the next zero."""
    return float(link[0, 3]), float(np.arctan2(-link[1, 2], link[2, 2])), float(link[2, 3])
