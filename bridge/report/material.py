"""Input of a report: the diagnosis, its log and model; and figures that sections share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gapbridge.bridge.document.blocks import Block, Heading
from gapbridge.bridge.document.drawing import AFTER, BEFORE
from gapbridge.bridge.report.labels import CHANNELS
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

SHOWN = 1500  # most points of a figure; the largest values are always drawn


@dataclass(frozen=True)
class Material:
    """Input of every section."""

    diagnosis: Diagnosis
    cell_name: str
    log: Log
    model: Model  # as it was before the diagnosis
    origin: Mapping[str, Any] = field(default_factory=dict)  # provenance: version, time, files


@dataclass(frozen=True)
class Shares:
    """Shares of the squared gap; they add up to one."""

    explained: float
    noise: float
    unexplained: float


def shares(channel: ChannelDiagnosis) -> Shares:
    """Return the shares of a channel's squared gap, from held-out figures where available."""
    total = max(channel.gap_rms**2, 1e-300)
    gap = after(channel)
    remaining = min(gap**2 / total, 1.0) if channel.causes else 1.0  # also of no gap at all
    if not channel.structured:
        return Shares(1 - remaining, remaining, 0.0)
    floor = channel.noise_floor_rms or 0.0
    noise = min(floor**2 / total, remaining)
    # what a quantity predicts of held-out samples is not noise, whatever the noise floor
    predictable = remaining * max((share for _, share in channel.depends_on), default=0.0)
    structure = min(max(remaining - noise, predictable), remaining)
    return Shares(1 - remaining, remaining - structure, structure)


def unexplained(channel: ChannelDiagnosis) -> float:
    """Return the rms of the unexplained gap beyond noise, in the channel's unit."""
    return max(
        channel.unexplained_rms, channel.gap_rms * float(np.sqrt(shares(channel).unexplained))
    )


def after(channel: ChannelDiagnosis) -> float:
    """Return the gap (rms) with the causes in the model, held out where available."""
    held_out = channel.remaining_rms_held_out
    return channel.remaining_rms if held_out is None else held_out


def per_sample(gap: Array, count: int) -> Array:
    """Return the norm (N,) of the first ``count`` coordinates of a gap (N, k)."""
    return np.asarray(np.linalg.norm(gap[:, :count], axis=1))


def held_out_pair(channel: ChannelDiagnosis) -> tuple[Array, Array] | None:
    """Return each kept sample's held-out rms per coordinate (N,), without and with the causes.

    None where there are too few poses to hold any out.
    """
    if channel.held_out is None:
        return None
    held_out = HeldOut(channel.selection)
    if not held_out.possible:
        return None
    return np.sqrt(held_out.squares(())), channel.held_out


def thinned(score: Array, most: int = SHOWN) -> Index:
    """Return indices of at most ``most`` samples: evenly spread, and the largest scores."""
    n = len(score)
    if n <= most:
        return np.arange(n)
    even = np.linspace(0, n - 1, most - most // 10).astype(np.int64)
    top = np.argsort(-score)[: most // 10]
    return np.unique(np.concatenate([even, top]))


def chosen_channel(diagnosis: Diagnosis) -> ChannelDiagnosis:
    """Return the main channel: the one with the largest ratio of gap to noise."""

    def excess(channel: ChannelDiagnosis) -> float:
        return channel.gap_rms / max(channel.noise_floor_rms or channel.gap_rms, 1e-300)

    gaps = [c for c in diagnosis.channels if c.verdict is not Verdict.NO_GAP]
    return max(gaps or list(diagnosis.channels), key=excess)


def before_and_after(
    channel: ChannelDiagnosis, before: Array, after: Array
) -> list[tuple[str, Array, str]]:
    """Return name, values and colour of each series; “after” only where there are causes."""
    series = [("before", before, BEFORE)]
    return [*series, ("after", after, AFTER)] if channel.causes else series


def channel_heading(diagnosis: Diagnosis, channel: ChannelDiagnosis) -> list[Block]:
    """Return a heading for a channel where there are several."""
    return [Heading(CHANNELS[channel.channel])] if len(diagnosis.channels) > 1 else []
