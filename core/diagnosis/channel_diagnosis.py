"""The diagnosis of one channel of a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.across_sessions import SessionTransfer
from gapbridge.core.diagnosis.causes import Cause, Considered
from gapbridge.core.diagnosis.generalisation import NO_GENERALISATION, Generalisation
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.residual_structure import dependence
from gapbridge.core.diagnosis.selection.candidate import joint_target
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import Term
from gapbridge.core.estimation.least_squares import basis_of


class Verdict(StrEnum):
    """The verdict on one channel or on all; the values are those of the JSON."""

    NO_GAP = "no_gap"
    EXPLAINED = "explained"
    PARTLY_EXPLAINED = "partly_explained"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class Where:
    """Where a gap lies, as shares of its sum of squares."""

    joints: tuple[tuple[int, float], ...]  # joint from 1, share of the gap's energy; largest first
    axes: tuple[float, ...]
    depends_on: tuple[tuple[str, float], ...]  # quantity, held-out R2


@dataclass(frozen=True)
class ChannelDiagnosis:
    """The diagnosis of one channel; figures per coordinate, in the channel's unit."""

    channel: str
    unit: str
    samples: int
    gap_rms: float
    gap_max: float
    noise_floor_rms: float | None
    remaining_rms: float
    remaining_rms_held_out: float | None
    where: Where
    causes: tuple[Cause, ...]
    considered: tuple[Considered, ...]
    unexplained_rms: float
    structured: bool
    p_value: float | None
    depends_on: tuple[tuple[str, float], ...]
    verdict: Verdict
    selection: Selection = field(repr=False)  # of a long recording: on its excerpt
    judgement: Judgement = field(repr=False)
    gap: Array = field(repr=False)  # (N, k) measured - predicted, frame fitted
    remaining: Array = field(repr=False)  # (N, k) with the causes in the model
    held_out: Array | None = field(repr=False)  # (kept,) rms of each held-out sample
    outliers: NDArray[np.int64] = field(repr=False)  # rows of the log that were excluded
    stand_ins: tuple[Cause, ...] = ()  # not accused, but reduce the gap in regions not fitted
    fitted_together: tuple[Term, ...] = ()  # causes and stand-ins
    generalisation: Generalisation = NO_GENERALISATION  # new region, new session
    noise_floor_source: str = "unknown"  # see Floor
    session_transfer: tuple[SessionTransfer, ...] = ()  # of causes, for several sessions


def locate(selection: Selection, gap: Array, accused: Sequence[int]) -> Where:
    """Return where the gap (N, k) of the kept samples lies.

    ``accused`` are candidate indices: their joints share the part that they explain. Without any,
    each joint's share is what an unnamed function of its own angle error could explain.
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
                # projection of the gap on this part: the parts then add up
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
