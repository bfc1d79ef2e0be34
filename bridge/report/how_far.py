"""How far: the gap before and after, on measurements that the fit did not see."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.report.fragment import (
    AFTER,
    BEFORE,
    EXPLAINED,
    FLOOR,
    LEFT,
    Cell,
    Figure,
    bar,
    figure_block,
    paragraph,
    table,
)
from gapbridge.bridge.report.material import Array, Material, held_out_pair, shares, thinned
from gapbridge.bridge.report.words import CHANNELS, effect_words, percent, told, unit_of
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis

BINS = 40


def section(material: Material) -> str:
    """Return the shares, and before and after for every channel."""
    parts = [_shares(material.diagnosis.channels)]
    for channel in material.diagnosis.channels:
        if len(material.diagnosis.channels) > 1:
            parts.append(f"<h3>{CHANNELS[channel.channel]}</h3>")
        parts.append(_channel(channel))
        parts.append(_sessions(channel, material.diagnosis.sessions))
    return "".join(parts)


def _shares(channels: tuple[ChannelDiagnosis, ...]) -> str:
    rows: list[list[Cell]] = []
    for c in channels:
        part = shares(c)
        rows.append([
            CHANNELS[c.channel], told(c.gap_rms, c.unit),
            told(c.remaining_rms_held_out, c.unit) if c.causes else "–",
            told(c.elsewhere.new_region, c.unit), told(c.elsewhere.new_session, c.unit),
            told(c.noise_floor_rms, c.unit),
            bar(part.explained, percent(part.explained), EXPLAINED),
            bar(part.noise, percent(part.noise), FLOOR),
            bar(part.unexplained, percent(part.unexplained), LEFT),
        ])  # fmt: skip
    heads = ("channel", "before", "after, held out", "in a new region",
             "in a new session", "noise", "explained", "noise share",
             "unexplained")  # fmt: skip
    return table(heads, rows)


def _channel(channel: ChannelDiagnosis) -> str:
    pair = held_out_pair(channel)
    parts = []
    if channel.causes:
        parts.append(_causes(channel))
    if pair is None:
        parts.append(paragraph("There are too few different poses to hold any out."))
        return "".join(parts)
    before, after = pair
    if not channel.causes:
        parts.append(paragraph("No cause was put into the model, so before and after are the same.",
                               "note"))  # fmt: skip
    parts += [figure_block(_histogram(channel, before, after)),
              figure_block(_by_sample(channel, before, after))]  # fmt: skip
    better = float(np.mean(after < before)) if channel.causes else None
    if better is not None:
        parts.append(paragraph(f"{percent(better)} of the held-out samples came closer."))
    return "".join(parts)


def _sessions(channel: ChannelDiagnosis, sessions: tuple[str, ...]) -> str:
    """Return how each session does under a fit of the others, and what changed between them."""
    found = channel.elsewhere.by_session
    if not found:
        return ""
    rows: list[list[Cell]] = [[sessions[s], told(rms, channel.unit)] for s, rms in found]
    parts = [table(("session", "left under a fit of the others"), rows)]
    for across in channel.carried:
        words = effect_words(across.effect)
        if across.carries:
            parts.append(paragraph(f"{words}: the same in all sessions that show it."))
            continue
        heads = ("changed between sessions", *(sessions[s] for s, _ in across.values))
        values = [parameters for _, parameters in across.values]
        lines: list[list[Cell]] = [
            [same[0].name, *(f"{p.value:.4g} ± {p.std or 0.0:.2g} {p.unit}" for p in same)]
            for same in zip(*values, strict=True)
        ]
        parts.append(table(heads, lines))
    return "".join(parts)


def _causes(channel: ChannelDiagnosis) -> str:
    rows: list[list[Cell]] = []
    for cause in channel.causes:
        s = cause.shrink
        if s is None:
            continue
        low, high = s.interval
        rows.append([
            effect_words(cause.effect), told(s.gap_without, channel.unit),
            told(s.gap_with, channel.unit),
            bar(s.shrink, f"{percent(s.shrink)} ({percent(low)} to {percent(high)})", EXPLAINED),
        ])  # fmt: skip
    heads = ("cause, all others kept in", "gap without it", "gap with it", "shrinks by (95 %)")
    return table(heads, rows) if rows else ""


def _histogram(channel: ChannelDiagnosis, before: Array, after: Array) -> Figure:
    name, factor = unit_of(channel.unit)
    most = float(max(before.max(), after.max())) * factor
    edges = np.linspace(0, max(most, 1e-12), BINS + 1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    given = [("before", before, BEFORE)] + ([("after", after, AFTER)] if channel.causes else [])
    traces = [
        {"type": "bar", "x": middle, "y": np.histogram(values * factor, edges)[0], "name": label,
         "marker": {"color": colour}, "opacity": 0.7, "width": float(edges[1])}
        for label, values, colour in given
    ]  # fmt: skip
    layout = {
        "barmode": "overlay", "xaxis": {"title": {"text": f"gap per coordinate ({name})"}},
        "yaxis": {"title": {"text": "samples"}}, **_floor_line(channel, vertical=True),
    }  # fmt: skip
    return Figure(traces, layout, "How many samples have which gap, held out. Dotted: the noise.",
                  height=300)  # fmt: skip


def _by_sample(channel: ChannelDiagnosis, before: Array, after: Array) -> Figure:
    name, factor = unit_of(channel.unit)
    rows = channel.selection.observation.rows[channel.selection.kept] + 1
    keep = thinned(before)
    given = [("before", before, BEFORE)] + ([("after", after, AFTER)] if channel.causes else [])
    traces = [
        {"type": "scatter", "mode": "markers", "x": rows[keep], "y": values[keep] * factor,
         "name": label, "marker": {"color": colour, "size": 5, "opacity": 0.75}}
        for label, values, colour in given
    ]  # fmt: skip
    layout = {
        "xaxis": {"title": {"text": "row of the log"}},
        "yaxis": {"title": {"text": f"gap per coordinate ({name})"}, "rangemode": "tozero"},
        **_floor_line(channel, vertical=False),
    }
    thin = f" {len(keep)} of {len(before)} samples are drawn." if len(keep) < len(before) else ""
    return Figure(traces, layout, f"Every sample, held out. Dotted: the noise.{thin}", height=320)


def _floor_line(channel: ChannelDiagnosis, *, vertical: bool) -> dict[str, object]:
    if channel.noise_floor_rms is None:
        return {}
    at = channel.noise_floor_rms * unit_of(channel.unit)[1]
    line = {"type": "line", "line": {"dash": "dot", "width": 1.5, "color": "#444"}}
    if vertical:
        return {"shapes": [line | {"x0": at, "x1": at, "y0": 0, "y1": 1, "yref": "paper"}]}
    return {"shapes": [line | {"y0": at, "y1": at, "x0": 0, "x1": 1, "xref": "paper"}]}
