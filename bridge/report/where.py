"""Where: joints, axes, and the quantities that the gap follows."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document.axes import Chart, scale
from gapbridge.bridge.document.blocks import Bar, Beside, Block, Cell, Gallery, Table
from gapbridge.bridge.document.drawing import Drawing
from gapbridge.bridge.report.arm_view import arm_view
from gapbridge.bridge.report.labels import percent, quantity_title, quantity_unit, unit_of
from gapbridge.bridge.report.material import (
    Material,
    before_and_after,
    channel_heading,
    own_coordinates,
    per_sample,
    thinned,
)
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis

MOST_QUANTITIES = 14
STATED = 0.02  # share below which a dependence is not worth a line
POINTS = 600  # of a drawing among many


def where(material: Material) -> list[Block]:
    """Return shares by joint and axis, the gap against quantities, and the arm in space."""
    blocks: list[Block] = []
    for channel in material.diagnosis.channels:
        blocks += channel_heading(material.diagnosis, channel)
        blocks += [Beside((_joints(channel), _axes(channel), _depends(channel)))]
        blocks.append(_against(channel))
        if channel.channel == "position":
            blocks.append(arm_view(channel, material))
    return blocks


def _joints(channel: ChannelDiagnosis) -> Table:
    rows: list[list[Cell]] = [
        [f"joint {j}", Bar(s, percent(s))] for j, s in channel.where.joints if s >= 0.005
    ]
    title = "share of the gap" if channel.causes else "gap this joint alone could make"
    return Table(("joint", title), rows or [["none", "no single joint stands out"]])


def _axes(channel: ChannelDiagnosis) -> Table:
    names = channel.selection.observation.axes
    rows: list[list[Cell]] = [
        [names[i], Bar(s, percent(s))] for i, s in enumerate(channel.where.axes)
    ]
    frame = {"position": "axis of base", "wrench": "axis of the flange"}.get(
        channel.channel, "axis"
    )
    return Table((frame, "share of the gap"), rows)


def _depends(channel: ChannelDiagnosis) -> Table:
    rows: list[list[Cell]] = [
        [quantity_title(n), Bar(s, percent(s))] for n, s in channel.where.depends_on if s > STATED
    ]
    heads = ("the gap depends on", "which predicts")
    return Table(heads, rows or [["none", "no single quantity of the log"]])


def _quantities(channel: ChannelDiagnosis) -> list[str]:
    """Return the quantities worth a look, most informative first."""
    have = channel.selection.observation.quantities
    first = [n for n, _ in (*channel.depends_on, *channel.where.depends_on)]
    plain = [n for n in ("payload", "timestamp") if n in have]
    joints = [f"approach_{j - 1}" for c in channel.causes for j in c.joints]
    rest = [n for n in have if n.startswith(("actual_q_", "target_q_"))]
    names = dict.fromkeys([*first[:4], *plain, *joints, *first[4:], *rest])
    return [n for n in names if n in have][:MOST_QUANTITIES]


def _against(channel: ChannelDiagnosis) -> Gallery:
    """Return the gap of every sample against what it may depend on, one drawing a choice."""
    kept = channel.selection.kept
    gap, after = channel.gap[kept], channel.remaining[kept]
    count = own_coordinates(channel)
    keep = thinned(per_sample(gap, count), POINTS)
    given = before_and_after(channel, gap[keep], after[keep])
    across, upwards = _abscissas(channel, keep), _ordinates(channel, given, count)
    drawings = [
        _scatter((x_title, x), (y_title, series))
        for _, y_title, series in upwards
        for _, x_title, x in across
    ]
    menus = (
        ("Show", tuple(label for label, _, _ in upwards)),
        ("Against", tuple(label for label, _, _ in across)),
    )
    return Gallery(
        menus, tuple(drawings), "The gap of the samples against what it may depend on; choose "
        "above. What the causes explain is gone from “after”."
        + (f" {len(keep)} of {len(gap)} samples are drawn." if len(keep) < len(gap) else ""),
    )  # fmt: skip


Series = list[tuple[str, Array, str]]  # name, values, colour


def _scatter(across: tuple[str, Array], upwards: tuple[str, Series]) -> Drawing:
    x_title, x = across
    y_title, series = upwards
    every = np.concatenate([values for _, values, _ in series])
    chart = Chart("", scale(x_title, [*x], tight=True, zero=False),
                  scale(y_title, [*every], tight=True), width=430, height=270)  # fmt: skip
    for _, values, colour in series:
        chart.points([*x], [*values], colour, radius=2.0, opacity=0.7)
    chart.legend([(name, colour) for name, _, colour in series])
    return chart.drawing


def _abscissas(channel: ChannelDiagnosis, keep: Index) -> list[tuple[str, str, Array]]:
    """Return label, axis title and values of what the gap can be drawn against."""
    observation, kept = channel.selection.observation, channel.selection.kept
    spread = np.random.default_rng(0).uniform(-0.08, 0.08, len(keep))
    choices = []
    for name in _quantities(channel):
        unit, factor = quantity_unit(name)
        values: Array = observation.quantities[name][kept][keep] * factor
        if name.startswith("approach_"):
            values = values + spread  # so that points at -1 and +1 do not hide each other
        title = quantity_title(name)
        choices.append((title, f"{title} ({unit})" if unit else title, values))
    if not choices:
        rows: Array = np.asarray(observation.rows[kept][keep] + 1, dtype=np.float64)
        choices.append(("row of the log", "row of the log", rows))
    return choices


def _ordinates(
    channel: ChannelDiagnosis, given: Series, count: int
) -> list[tuple[str, str, Series]]:
    """Return label, axis title and series: the largest coordinate, the size, the others."""
    unit, factor = unit_of(channel.unit)
    names = channel.selection.observation.axes
    size = ("size of the gap", f"gap ({unit})",
            [(n, per_sample(g, count) * factor, c) for n, g, c in given])  # fmt: skip
    order = np.argsort(-np.asarray(channel.where.axes)[:count])
    single = [
        (f"along {names[i]}" if count == 3 else names[i], f"gap, {names[i]} ({unit})",
         [(n, g[:, i] * factor, c) for n, g, c in given])
        for i in order
    ]  # fmt: skip
    return [*single[:1], size, *single[1:]]
