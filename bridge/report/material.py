"""The material of a report: the diagnosis, the log and the model it is about."""

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

SHOWN = 1500  # points a figure draws at most; outliers and extremes are not thinned away


@dataclass(frozen=True)
class Material:
    """All that a section may speak about."""

    diagnosis: Diagnosis
    cell_name: str
    log: Log
    model: Model  # as it was before the diagnosis
    origin: Mapping[str, Any] = field(default_factory=dict)  # provenance: version, time, files


@dataclass(frozen=True)
class Shares:
    """Of a gap's energy: what is explained, noise, and unexplained; they add up to one."""

    explained: float
    noise: float
    unexplained: float


def shares(channel: ChannelDiagnosis) -> Shares:
    """Return the shares of a channel's gap; held out where held-out figures can be had."""
    total = max(channel.gap_rms**2, 1e-300)
    left = after(channel) if channel.causes else channel.gap_rms
    rest = min(left**2 / total, 1.0)
    if not channel.structured:
        return Shares(1 - rest, rest, 0.0)
    floor = channel.noise_floor_rms or 0.0
    noise = min(floor**2 / total, rest)
    # what a quantity predicts of samples that it did not see is no noise, whatever the floor says
    predictable = rest * max((share for _, share in channel.depends_on), default=0.0)
    beyond = min(max(rest - noise, predictable), rest)
    return Shares(1 - rest, rest - beyond, beyond)


def unexplained(channel: ChannelDiagnosis) -> float:
    """Return the rms of what is left and no noise, in the channel's unit."""
    return max(
        channel.unexplained_rms, channel.gap_rms * float(np.sqrt(shares(channel).unexplained))
    )


def after(channel: ChannelDiagnosis) -> float:
    """Return the gap with the causes in the model, held out where that can be had."""
    held = channel.remaining_rms_held_out
    return channel.remaining_rms if held is None else held


def per_sample(gap: Array, count: int) -> Array:
    """Return the length (N,) of the first ``count`` coordinates of a gap."""
    return np.asarray(np.linalg.norm(gap[:, :count], axis=1))


def held_out_pair(channel: ChannelDiagnosis) -> tuple[Array, Array] | None:
    """Return the rms per coordinate of each kept sample, held out: without and with the causes.

    None where samples cannot be held out.
    """
    if channel.held_out is None:
        return None
    held = HeldOut(channel.selection)
    if not held.possible:
        return None
    return np.sqrt(held.squares(())), channel.held_out


def thinned(score: Array, most: int = SHOWN) -> Index:
    """Return indices of at most ``most`` samples: evenly spread, and the largest scores."""
    n = len(score)
    if n <= most:
        return np.arange(n)
    even = np.linspace(0, n - 1, most - most // 10).astype(np.int64)
    top = np.argsort(-score)[: most // 10]
    return np.unique(np.concatenate([even, top]))


def chosen_channel(diagnosis: Diagnosis) -> ChannelDiagnosis:
    """Return the channel to speak of first: the one with the largest gap over its noise."""

    def excess(channel: ChannelDiagnosis) -> float:
        return channel.gap_rms / max(channel.noise_floor_rms or channel.gap_rms, 1e-300)

    gaps = [c for c in diagnosis.channels if c.verdict is not Verdict.NO_GAP]
    return max(gaps or list(diagnosis.channels), key=excess)


def before_and_after(
    channel: ChannelDiagnosis, before: Array, after: Array
) -> list[tuple[str, Array, str]]:
    """Return name, values and colour of what is drawn: after only where there are causes."""
    given = [("before", before, BEFORE)]
    return [*given, ("after", after, AFTER)] if channel.causes else given


def channel_heading(diagnosis: Diagnosis, channel: ChannelDiagnosis) -> list[Block]:
    """Return a heading for a channel where there are several."""
    return [Heading(CHANNELS[channel.channel])] if len(diagnosis.channels) > 1 else []
