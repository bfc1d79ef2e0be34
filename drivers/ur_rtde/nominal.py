"""Offset mode: from the robot's target joints, which hold the offset, back to what it wants itself.

The robot's program adds the applied offset to the pose of its own motion and turns the sum into
joints; a sample carries both the sum (``target_q``) and the offset applied in that cycle. The
nominal joints are those near ``target_q`` at which the rigid arm's TCP is that offset short of it.
The model must have the TCP that is set in the controller.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from core import kernel
from core.compensation import LEVER, newton_step
from core.errors import InvalidStateError
from core.kernel import Rows
from core.model import Model
from core.rotation import rotation_matrix

Vector = NDArray[np.float64]
TOLERANCE = 1e-10  # m
STEPS = 8


class Nominal:
    """Takes offsets out of target joints; keeps its buffers, for one thread."""

    def __init__(self, model: Model) -> None:
        n = model.arm.n
        self._chain = model.without_terms().chain()
        self._shape = kernel.new_shape(n)
        self._rows = Rows(
            np.zeros((1, n)), np.ones((1, n)), np.zeros(1), np.zeros((1, 3)), np.zeros((1, 6))
        )
        self._shift = np.zeros(n)  # target minus nominal joints of the last sample
        self._step = np.empty(n)
        # compiled here: the loop's first offset must not wait for a compiler
        position, rotation = self.tcp(self._shift)
        newton_step(self._chain, self._rows, 0, self._shape, position, rotation, LEVER, self._step)

    def tcp(self, q: Vector) -> tuple[Vector, Vector]:
        """Return position (3,) and rotation (3, 3) of the rigid arm's TCP at joints q (n,)."""
        self._rows.q[0] = q
        kernel.equilibrium(self._chain, self._rows, 0, self._shape)
        return self._shape.tcp_position.copy(), self._shape.tcp_rotation.copy()

    def without(self, target_q: Vector, offset_in_base: Vector) -> Vector:
        """Return the joints (n,) whose TCP, moved by the offset (6,), is that of ``target_q``.

        Raises InvalidStateError where there are none nearby (at a singularity).
        """
        if not offset_in_base.any():
            self._shift[:] = 0.0
            return target_q
        position, rotation = self.tcp(target_q)
        position -= offset_in_base[:3]
        rotation = rotation_matrix(-offset_in_base[3:]) @ rotation
        q = self._rows.q
        q[0] = target_q - self._shift
        for _ in range(STEPS):
            distance = newton_step(
                self._chain, self._rows, 0, self._shape, position, rotation, LEVER, self._step
            )
            if distance < TOLERANCE:
                break
            q[0] += self._step
        else:
            self._shift[:] = 0.0
            raise InvalidStateError(
                f"target_q: found no joints {distance:.1e} m nearer to the robot's own path "
                f"without the offset {np.array2string(offset_in_base, precision=5)}"
            )
        nominal: Vector = q[0].copy()
        self._shift[:] = target_q - nominal
        return nominal
