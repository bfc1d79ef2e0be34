"""What was found in one channel of a log."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.across_sessions import Carried
from gapbridge.core.diagnosis.causes import Cause, Considered
from gapbridge.core.diagnosis.generalisation import NOWHERE, Generalisation
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.location import Where
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import Term


@dataclass(frozen=True)
class ChannelDiagnosis:
    """What was found in one channel; figures per coordinate, in the channel's unit."""

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
    verdict: str
    selection: Selection = field(repr=False)  # of a long recording that of its excerpt
    judgement: Judgement = field(repr=False)
    gap: Array = field(repr=False)  # (N, k) measured - predicted, frame fitted
    remaining: Array = field(repr=False)  # (N, k) with the causes in the model
    held_out: Array | None = field(repr=False)  # (kept,) rms of each held-out sample
    outliers: NDArray[np.int64] = field(repr=False)  # rows of the log that were excluded
    stand_ins: tuple[Cause, ...] = ()  # not proved, but useful where nothing was fitted
    along: tuple[Term, ...] = ()  # causes and stand-ins, fitted together
    elsewhere: Generalisation = NOWHERE  # new region, new session
    noise_floor_source: str = "unknown"  # what measured it
    carried: tuple[Carried, ...] = ()  # of causes, where several sessions show them
