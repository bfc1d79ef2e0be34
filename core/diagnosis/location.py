"""Where a gap lies: joints, axes, and the quantities that it follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.residual_structure import dependence
from gapbridge.core.diagnosis.selection.candidate import joint_target
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.estimation.least_squares import basis_of


@dataclass(frozen=True)
class Where:
    """Shares of a gap."""

    joints: tuple[tuple[int, float], ...]  # joint from 1, share of the gap's energy; largest first
    axes: tuple[float, ...]
    depends_on: tuple[tuple[str, float], ...]  # quantity, held-out R2


def locate(selection: Selection, gap: Array, accused: Sequence[int]) -> Where:
    """Return where the gap (N, k) of the kept samples lies.

    ``accused`` are candidate indices: their joints share the part that they explain. Without any,
    each joint is asked how much of the gap a turn of it alone could make.
    """
    space = selection.space
    own = gap[:, : min(gap.shape[1], 3)] if selection.observation.channel in (
        "position", "wrench") else gap  # fmt: skip
    energy = np.sum(own**2, axis=0)
    axes = tuple(float(v) for v in energy / max(float(energy.sum()), 1e-300))
    total = max(float(space.y @ space.y), 1e-300)
    shares: dict[int, float] = {}
    if accused:
        values = selection.fitted(accused)
        for c in accused:
            joint = space.candidates[c].site.joint
            if joint is not None:
                part = space.X[:, space.start[c] : space.start[c + 1]] @ values[c]
                # what of the gap points along this part: parts of one gap then add up
                shares[joint] = shares.get(joint, 0.0) + float(part @ space.y) / total
    else:
        columns = selection.observation.joint_columns
        joints = {} if columns is None else {
            joint_target(j): j for j in range(1, columns.shape[2] + 1)
        }  # fmt: skip
        for c, candidate in enumerate(space.candidates):
            joint = joints.get(candidate.target)
            if candidate.quantity and joint is not None:
                basis = basis_of(space.X[:, space.start[c] : space.start[c + 1]])
                share = float(np.sum((basis.T @ space.y) ** 2)) / total
                shares[joint] = max(shares.get(joint, 0.0), share)
    ranked = sorted(((j, min(max(s, 0.0), 1.0)) for j, s in shares.items()), key=lambda i: -i[1])
    depends = dependence(space, selection.nuisance_basis, (), selection.groups)
    return Where(tuple(ranked), axes, tuple(depends[:6]))
