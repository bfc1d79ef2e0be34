"""Offset mode: from the robot's target joints, which include the offset, to its nominal joints.

The robot's program adds the applied offset to the pose of its own motion and converts the sum to
joints; a sample contains that sum (``target_q``) and the offset applied in that cycle. The nominal
joints are those near ``target_q`` whose rigid TCP pose plus the offset is the pose at ``target_q``.
The model must have the TCP that is set in the controller.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import InvalidStateError
from gapbridge.core.kernels.packed import arm_block
from gapbridge.core.kernels.single import NEARER, SCRATCH, take_out
from gapbridge.core.model import Model


class Nominal:
    """Removes offsets from target joints; reuses its buffers, for one thread."""

    def __init__(self, model: Model) -> None:
        self._n = n = model.arm.n
        rigid = arm_block(model.without_terms().chain())
        self._block = np.concatenate([rigid, np.zeros(n + SCRATCH + 12 + n + 6)])
        self._target, self._offset = self._block[-n - 6 : -6], self._block[-6:]
        # compiles the kernel: the loop's first offset must not wait for it
        self.without(np.zeros(n), np.zeros(6))

    def without(self, target_q: Array, offset_in_base: Array | Sequence[float]) -> Array:
        """Return the joints (n,) whose TCP, moved by the offset (6,), is that of ``target_q``.

        Raises InvalidStateError if there are none nearby (at a singularity).
        """
        nominal: Array = np.empty(self._n)
        self._target[:], self._offset[:] = target_q, offset_in_base
        distance = take_out(self._block, nominal)
        if not distance < NEARER:
            raise InvalidStateError(
                f"target_q: found no joints {distance:.1e} m nearer to the robot's own path "
                f"without the offset {np.array2string(self._offset, precision=5)}"
            )
        return nominal
