"""Where: joints, axes, and the quantities that the gap follows."""

from __future__ import annotations

from typing import Any

import numpy as np

from gapbridge.bridge.report.arm_view import arm_figure
from gapbridge.bridge.report.fragment import (
    AFTER,
    BEFORE,
    Cell,
    Choice,
    Figure,
    bar,
    figure_block,
    heading,
    paragraph,
    table,
)  # fmt: skip
from gapbridge.bridge.report.material import (
    Array,
    Index,
    Material,
    own_coordinates,
    per_sample,
    thinned,
)
from gapbridge.bridge.report.words import CHANNELS, percent, quantity_unit, quantity_words, unit_of
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis

MOST_QUANTITIES = 14
STATED = 0.02  # share below which a dependence is not worth a line


def section(material: Material) -> str:
    """Return shares by joint and axis, the gap against quantities, and the arm in 3D."""
    parts = []
    for channel in material.diagnosis.channels:
        if len(material.diagnosis.channels) > 1:
            parts.append(heading(CHANNELS[channel.channel]))
        parts.append(_channel(channel))
        if channel.channel == "position":
            parts.append(figure_block(arm_figure(channel, material)))
    return "".join(parts)


def _channel(channel: ChannelDiagnosis) -> str:
    tables = [_joints(channel), _axes(channel), _depends(channel)]
    grid = f'<div class="grid">{"".join(f"<div>{t}</div>" for t in tables if t)}</div>'
    return grid + figure_block(_against(channel))


def _joints(channel: ChannelDiagnosis) -> str:
    rows: list[list[Cell]] = [
        [f"joint {j}", bar(s, percent(s))] for j, s in channel.where.joints if s >= 0.005
    ]
    if not rows:
        return paragraph("No single joint stands out.", "note")
    title = "share of the gap" if channel.causes else "gap this joint alone could make"
    return table(("joint", title), rows)


def _axes(channel: ChannelDiagnosis) -> str:
    names = channel.selection.observation.axes
    rows: list[list[Cell]] = [
        [names[i], bar(s, percent(s))] for i, s in enumerate(channel.where.axes)
    ]
    frame = {"position": "axis of base", "wrench": "axis of the flange"}.get(
        channel.channel, "axis"
    )
    return table((frame, "share of the gap"), rows)


def _depends(channel: ChannelDiagnosis) -> str:
    rows: list[list[Cell]] = [
        [quantity_words(n), bar(s, percent(s))] for n, s in channel.where.depends_on if s > STATED
    ]
    if not rows:
        return paragraph("The gap follows no single quantity of the log.", "note")
    return table(("the gap follows", "predicts of it"), rows)


def _quantities(channel: ChannelDiagnosis) -> list[str]:
    """Return the quantities worth a look, most informative first."""
    have = channel.selection.observation.quantities
    first = [n for n, _ in (*channel.depends_on, *channel.where.depends_on)]
    plain = [n for n in ("payload", "timestamp") if n in have]
    joints = [f"approach_{j - 1}" for c in channel.causes for j in c.joints]
    rest = [n for n in have if n.startswith(("actual_q_", "target_q_"))]
    names = dict.fromkeys([*first[:4], *plain, *joints, *first[4:], *rest])
    return [n for n in names if n in have][:MOST_QUANTITIES]


def _against(channel: ChannelDiagnosis) -> Figure:
    kept = channel.selection.kept
    gap, after = channel.gap[kept], channel.remaining[kept]
    count = own_coordinates(channel)
    keep = thinned(per_sample(gap, count))
    given = [("before", gap, BEFORE)] + ([("after", after, AFTER)] if channel.causes else [])
    traces: list[dict[str, Any]] = [
        {"type": "scattergl" if len(keep) > 3000 else "scatter", "mode": "markers", "name": label,
         "marker": {"color": colour, "size": 5, "opacity": 0.7}}
        for label, _, colour in given
    ]  # fmt: skip
    x = _x_choices(channel, keep, len(given))
    y = _y_choices(channel, [values[keep] for _, values, _ in given], count)
    for i, trace in enumerate(traces):
        trace |= {"x": x[0].values[i], "y": y[0].values[i]}
    layout = {
        "xaxis": {"title": {"text": x[0].title}},
        "yaxis": {"title": {"text": y[0].title}},
    }
    return Figure(
        traces, layout, "The gap of every sample against what it may follow; choose above. What "
        "the causes explain is gone from the blue points.", choices={"y": y, "x": x},
    )  # fmt: skip


def _x_choices(channel: ChannelDiagnosis, keep: Index, traces: int) -> list[Choice]:
    observation, kept = channel.selection.observation, channel.selection.kept
    spread = np.random.default_rng(0).uniform(-0.08, 0.08, len(keep))
    choices = []
    for name in _quantities(channel):
        unit, factor = quantity_unit(name)
        values: Array = observation.quantities[name][kept][keep] * factor
        if name.startswith("approach"):
            values = values + spread  # so that points at -1 and +1 do not hide each other
        words = quantity_words(name)
        title = f"{words} ({unit})" if unit else words
        choices.append(Choice(words, title, [values] * traces))
    if not choices:
        rows: Array = np.asarray(observation.rows[kept][keep] + 1, dtype=np.float64)
        choices.append(Choice("row of the log", "row of the log", [rows] * traces))
    return choices


def _y_choices(channel: ChannelDiagnosis, gaps: list[Array], count: int) -> list[Choice]:
    name, factor = unit_of(channel.unit)
    names = channel.selection.observation.axes
    size = Choice("size of the gap", f"gap ({name})", [per_sample(g, count) * factor for g in gaps])
    order = np.argsort(-np.asarray(channel.where.axes)[:count])
    single = [
        Choice(f"along {names[i]}" if count == 3 else names[i], f"gap, {names[i]} ({name})",
               [g[:, i] * factor for g in gaps])
        for i in order
    ]  # fmt: skip
    return [*single[:1], size, *single[1:]]
