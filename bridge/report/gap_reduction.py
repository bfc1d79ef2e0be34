"""Section “How far it shrinks”: the gap before and after, on held-out measurements."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document.axes import Chart, distribution, scale
from gapbridge.bridge.document.blocks import Bar, Block, Cell, Paragraph, Pictures, Table
from gapbridge.bridge.document.drawing import BAD_DOT, EDGE, LIMIT
from gapbridge.bridge.document.numbers import percent, unit_of, with_unit
from gapbridge.bridge.report.labels import CHANNELS, effect_title
from gapbridge.bridge.report.material import (
    Material,
    before_and_after,
    channel_heading,
    held_out_pair,
    shares,
    thinned,
)
from gapbridge.bridge.report.slips import mark_rows, slips_of
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.finding import Slip


def gap_reduction(material: Material) -> list[Block]:
    """Return the shares of the gap, and for every channel the gap before and after."""
    diagnosis = material.diagnosis
    blocks: list[Block] = [_shares(diagnosis.channels)]
    for channel in diagnosis.channels:
        blocks += channel_heading(diagnosis, channel)
        blocks += _channel(channel, slips_of(diagnosis, channel))
        blocks += _sessions(channel, diagnosis.sessions)
    return blocks


def _shares(channels: tuple[ChannelDiagnosis, ...]) -> Table:
    rows: list[list[Cell]] = []
    for c in channels:
        part = shares(c)
        rows.append([
            CHANNELS[c.channel], with_unit(c.gap_rms, c.unit),
            with_unit(c.remaining_rms_held_out, c.unit) if c.causes else "–",
            with_unit(c.generalisation.new_region, c.unit),
            with_unit(c.generalisation.new_session, c.unit),
            with_unit(c.noise_floor_rms, c.unit),
            Bar(part.explained, percent(part.explained), LIMIT),
            Bar(part.noise, percent(part.noise), EDGE),
            Bar(part.unexplained, percent(part.unexplained), BAD_DOT),
        ])  # fmt: skip
    heads = ("channel", "before", "after, held out", "in a new region", "in a new session",
             "noise", "explained", "noise share", "unexplained")  # fmt: skip
    return Table(heads, rows)


def _channel(channel: ChannelDiagnosis, slips: list[Slip]) -> list[Block]:
    pair = held_out_pair(channel)
    blocks: list[Block] = [_causes(channel)] if any(c.shrink for c in channel.causes) else []
    if pair is None:
        return [*blocks, Paragraph("There are too few different poses for held-out figures.")]
    before, after = pair
    if not channel.causes:
        text = "No cause was added to the model, so before and after are the same."
        blocks.append(Paragraph(text, "note"))
    blocks.append(_pictures(channel, before, after, slips))
    if channel.causes:
        better = float(np.mean(after < before))
        blocks.append(Paragraph(f"{percent(better)} of the held-out samples have a smaller gap."))
    return blocks


def _sessions(channel: ChannelDiagnosis, sessions: tuple[str, ...]) -> list[Block]:
    """Return each session's gap under a fit of the others, and what changed between sessions."""
    by_session = channel.generalisation.by_session
    if not by_session:
        return []
    rows: list[list[Cell]] = [[sessions[s], with_unit(rms, channel.unit)] for s, rms in by_session]
    blocks: list[Block] = [Table(("session", "residual under a fit of the others"), rows)]
    for across in channel.session_transfer:
        title = effect_title(across.effect)
        if across.transfers:
            blocks.append(Paragraph(f"{title}: the same in all sessions that show it."))
            continue
        heads = ("changed between sessions", *(sessions[s] for s, _ in across.values))
        values = [parameters for _, parameters in across.values]
        lines: list[list[Cell]] = [
            [
                same[0].name,
                *(p.session or f"{p.value:.4g} ± {p.std or 0.0:.2g} {p.unit}" for p in same),
            ]
            for same in zip(*values, strict=True)
        ]
        blocks.append(Table(heads, lines))
    return blocks


def _causes(channel: ChannelDiagnosis) -> Table:
    rows: list[list[Cell]] = []
    for cause in channel.causes:
        s = cause.shrink
        if s is None:
            continue
        low, high = s.interval
        rows.append([
            effect_title(cause.effect), with_unit(s.gap_without, channel.unit),
            with_unit(s.gap_with, channel.unit),
            Bar(s.shrink, f"{percent(s.shrink)} ({percent(low)} to {percent(high)})", LIMIT),
        ])  # fmt: skip
    heads = ("cause, all others in the model", "gap without it", "gap with it", "reduction (95 %)")
    return Table(heads, rows, (2.4, 1, 1, 2))


def _pictures(
    channel: ChannelDiagnosis, before: Array, after: Array, slips: list[Slip]
) -> Pictures:
    name, factor = unit_of(channel.unit)
    series = [
        (label, values * factor, colour)
        for label, values, colour in before_and_after(channel, before, after)
    ]
    floor = channel.noise_floor_rms
    level = None if floor is None else floor * factor
    share = distribution("Distribution of the gap", f"gap per coordinate, {name}", series)
    if level is not None and share.x.low <= level <= share.x.high:
        share.upright(level, "noise", EDGE)
    keep = thinned(before)
    note = f" {len(keep)} of {len(before)} samples are drawn." if len(keep) < len(before) else ""
    rows = channel.selection.observation.rows[channel.selection.kept][keep] + 1
    by_sample = _by_sample(rows, [(n, v[keep], c) for n, v, c in series], name, level)
    mark_rows(by_sample, channel, slips)
    return Pictures(
        (share.drawing, by_sample.drawing),
        "Held-out samples. Left: cumulative distribution of the gap, logarithmic. Right: every "
        f"sample. Dashed: the noise.{note}",
    )


def _by_sample(
    rows: Index, series: list[tuple[str, Array, str]], unit: str, level: float | None
) -> Chart:
    highest = [level or 0.0, *(float(values.max()) for _, values, _ in series)]
    chart = Chart("Every sample", scale("row of the log", [*rows], tight=True),
                  scale(f"gap per coordinate, {unit}", highest))  # fmt: skip
    for _, values, colour in series:
        chart.points([*rows], [*values], colour, radius=1.8, opacity=0.7)
    if level is not None:
        chart.level(level, "noise", EDGE)
    chart.legend([(label, colour) for label, _, colour in series])
    return chart
