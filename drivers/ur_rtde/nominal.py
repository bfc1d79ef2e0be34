"""Offset mode: from the robot's target joints, which hold the offset, back to what it wants itself.

The robot's program adds the applied offset to the pose of its own motion and turns the sum into
joints; a sample carries both the sum (``target_q``) and the offset applied in that cycle. The
nominal joints are those near ``target_q`` at which the rigid arm's TCP is that offset short of it.
The model must have the TCP that is set in the controller.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from core import kernel
from core.compensation import LEVER, newton_step
from core.errors import InvalidStateError
from core.kernel import JIT, Rows
from core.model import Model
from core.packed import chain_of, pack, row_of, shape_of

Vector = NDArray[np.float64]
TOLERANCE = 1e-10  # m
STEPS = 8


@njit(**JIT)
def _turned_back(vector, R, out):  # type: ignore[no-untyped-def]
    """Write exp(-vector) R (3, 3) for a rotation vector (3,) in rad (Rodrigues' formula)."""
    x, y, z = -vector[0], -vector[1], -vector[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    # both factors by their series where the quotients would lose digits
    first = np.sin(angle) / angle if angle > 1e-4 else 1.0 - square / 6.0
    half = 0.5 * angle
    sinc = np.sin(half) / half if angle > 1e-4 else 1.0 - square / 24.0
    second = 0.5 * sinc * sinc
    for k in range(3):
        a, b, c = R[0, k], R[1, k], R[2, k]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a  # vector x column
        out[0, k] = a + first * u + second * (y * w - z * v)
        out[1, k] = b + first * v + second * (z * u - x * w)
        out[2, k] = c + first * w + second * (x * v - y * u)


@njit(**JIT)
def _tcp(chain_block, row_block, shape_block, q, position, rotation):  # type: ignore[no-untyped-def]
    """Write position (3,) and rotation (3, 3) of the rigid arm's TCP at joints q (n,)."""
    n = q.shape[0]
    row, shape = row_of(row_block, n), shape_of(shape_block, n)
    row.q[0, :] = q
    kernel.equilibrium(chain_of(chain_block, n), row, 0, shape)
    position[:] = shape.tcp_position
    rotation[:, :] = shape.tcp_rotation


@njit(**JIT)
def _without(chain_block, row_block, shape_block, target, offset, shift, nominal):  # type: ignore[no-untyped-def]
    """Write the nominal joints (n,) and how far ``target`` is from them; returns the distance (m).

    ``shift`` (n,) holds the one of the sample before, from where the search begins.
    """
    n = target.shape[0]
    chain, row, shape = chain_of(chain_block, n), row_of(row_block, n), shape_of(shape_block, n)
    position, rotation, step = np.empty(3), np.empty((3, 3)), np.empty(n)
    q = row.q[0]
    q[:] = target
    kernel.equilibrium(chain, row, 0, shape)
    for k in range(3):
        position[k] = shape.tcp_position[k] - offset[k]
    _turned_back(offset[3:], shape.tcp_rotation, rotation)
    for i in range(n):
        q[i] = target[i] - shift[i]
    distance = np.inf
    for _ in range(STEPS):
        distance = newton_step(chain, row, 0, shape, position, rotation, LEVER, step)
        if distance < TOLERANCE:
            break
        for i in range(n):
            q[i] += step[i]
    found = distance < TOLERANCE
    for i in range(n):
        nominal[i] = q[i]
        shift[i] = target[i] - q[i] if found else 0.0
    return distance


class Nominal:
    """Takes offsets out of target joints; keeps its buffers, for one thread."""

    def __init__(self, model: Model) -> None:
        self._n = n = model.arm.n
        self._chain = pack(model.without_terms().chain())
        self._shape = pack(kernel.new_shape(n))
        self._row = pack(
            Rows(np.zeros((1, n)), np.ones((1, n)), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 6)))
        )
        self._offset, self._target = np.zeros(6), np.zeros(n)
        self._shift = np.zeros(n)  # target minus nominal joints of the last sample
        # compiled here: the loop's first offset must not wait for a compiler
        self.tcp(self._shift)
        self._search(np.zeros(n), np.zeros(6), np.empty(n))

    def tcp(self, q: Vector) -> tuple[Vector, Vector]:
        """Return position (3,) and rotation (3, 3) of the rigid arm's TCP at joints q (n,)."""
        position, rotation = np.empty(3), np.empty((3, 3))
        _tcp(self._chain, self._row, self._shape, np.array(q, float), position, rotation)
        return position, rotation

    def without(self, target_q: Vector, offset_in_base: Vector) -> Vector:
        """Return the joints (n,) whose TCP, moved by the offset (6,), is that of ``target_q``.

        Raises InvalidStateError where there are none nearby (at a singularity).
        """
        if not any(offset_in_base.tolist()):
            self._shift[:] = 0.0
            return target_q
        nominal: Vector = np.empty(self._n)
        offset, target = self._offset, self._target
        offset[:], target[:] = offset_in_base, target_q
        distance = self._search(target, offset, nominal)
        if not distance < TOLERANCE:
            raise InvalidStateError(
                f"target_q: found no joints {distance:.1e} m nearer to the robot's own path "
                f"without the offset {np.array2string(offset_in_base, precision=5)}"
            )
        return nominal

    def _search(self, target_q: Vector, offset_in_base: Vector, nominal: Vector) -> float:
        """Return the distance (m) left; writes the nominal joints (n,)."""
        return float(
            _without(
                self._chain, self._row, self._shape, target_q, offset_in_base, self._shift, nominal
            )
        )
