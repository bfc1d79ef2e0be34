"""Sections “Where the gap lies” (joints, axes, quantities) and “Which effect causes it”."""

from __future__ import annotations

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, Scale, scale
from gapbridge.bridge.document.drawing import EDGE, SOFT, Drawing
from gapbridge.bridge.document.findings import considered_text
from gapbridge.bridge.document.numbers import likelihood, percent, unit_of
from gapbridge.bridge.document.scene import Arrows, Path, Scene, base
from gapbridge.bridge.document.skeleton import reach, round_factor, skeleton
from gapbridge.bridge.document.time_scale import time_scale
from gapbridge.bridge.report.labels import (
    effect_title,
    joint_list,
    listed,
    quantity_title,
    quantity_unit,
)
from gapbridge.bridge.report.material import (
    Material,
    before_and_after,
    channel_heading,
    per_sample,
    thinned,
)
from gapbridge.bridge.report.slips import mark, slips_of
from gapbridge.core.arrays import Array, Index
from gapbridge.core.diagnosis.causes import Cause, Considered, Outcome
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.finding import Slip
from gapbridge.core.diagnosis.noise_floor import own_coordinates
from gapbridge.core.log.log import Log
from gapbridge.core.planning.travel import spread_rows

MOST_QUANTITIES = 14
TIME = quantity_title("timestamp")
MIN_SHARE = 0.02  # smallest dependence that is listed
POINTS = 600  # most points of a scatter plot
ARROWS = 250  # most error arrows
DRAWN_POSES = 4  # in which the arm is drawn
ARROW_LENGTH = 0.18  # of a large error, as a share of the arm's reach
HEADS = ("effect", "verdict", "reduction alone", "probability", "reason")
NOTE = (
    "“Alone” is the reduction of the gap on held-out measurements if this effect were the only "
    "one in the model. An effect can score well alone and still be rejected, where another "
    "explains the same better or with fewer parameters."
)


def gap_location(material: Material) -> list[blocks.Block]:
    """Return shares by joint and axis, scatter plots of the gap, and a view of the arm."""
    shown: list[blocks.Block] = []
    for channel in material.diagnosis.channels:
        shown += channel_heading(material.diagnosis, channel)
        shown += [blocks.TableRow((_joints(channel), _axes(channel), _depends(channel)))]
        shown.append(_against(channel, slips_of(material.diagnosis, channel), material.log))
        if channel.channel == "position":
            shown.append(arm_view(channel, material))
    return shown


def _joints(channel: ChannelDiagnosis) -> blocks.Table:
    rows: list[list[blocks.Cell]] = [
        [f"joint {j}", blocks.Bar(s, percent(s))] for j, s in channel.where.joints if s >= 0.005
    ]
    title = "share of the gap" if channel.causes else "gap this joint alone could cause"
    return blocks.Table(("joint", title), rows or [["none", "no single joint stands out"]])


def _axes(channel: ChannelDiagnosis) -> blocks.Table:
    names = channel.selection.observation.axes
    rows: list[list[blocks.Cell]] = [
        [names[i], blocks.Bar(s, percent(s))] for i, s in enumerate(channel.where.axes)
    ]
    frame = {"position": "axis of base", "wrench": "axis of the flange"}.get(
        channel.channel, "axis"
    )
    return blocks.Table((frame, "share of the gap"), rows)


def _depends(channel: ChannelDiagnosis) -> blocks.Table:
    rows: list[list[blocks.Cell]] = [
        [quantity_title(n), blocks.Bar(s, percent(s))]
        for n, s in channel.where.depends_on
        if s > MIN_SHARE
    ]
    heads = ("the gap depends on", "share it predicts")
    return blocks.Table(heads, rows or [["none", "no single quantity of the log"]])


def _quantities(channel: ChannelDiagnosis) -> list[str]:
    """Return the quantities to plot the gap against, most informative first."""
    available = channel.selection.observation.quantities
    first = [n for n, _ in (*channel.depends_on, *channel.where.depends_on)]
    general = [n for n in ("payload", "timestamp") if n in available]
    joints = [f"approach_{j - 1}" for c in channel.causes for j in c.joints]
    angles = [n for n in available if n.startswith(("actual_q_", "target_q_"))]
    names = dict.fromkeys([*first[:4], *general, *joints, *first[4:], *angles])
    return [n for n in names if n in available][:MOST_QUANTITIES]


def _against(channel: ChannelDiagnosis, slips: list[Slip], log: Log) -> blocks.Gallery:
    """Return scatter plots of the gap against each quantity; menus choose the plot."""
    kept = channel.selection.kept
    gap, after = channel.gap[kept], channel.remaining[kept]
    count = own_coordinates(channel.selection.observation)
    keep = thinned(per_sample(gap, count), POINTS)
    series = before_and_after(channel, gap[keep], after[keep])
    across, upwards = _abscissas(channel, keep, log), _ordinates(channel, series, count)
    drawings = [
        _scatter((axis, x), (y_title, series), slips if label == TIME else [])
        for _, y_title, series in upwards
        for label, axis, x in across
    ]
    menus = (
        ("Show", tuple(label for label, _, _ in upwards)),
        ("Against", tuple(label for label, _, _ in across)),
    )
    return blocks.Gallery(
        menus, tuple(drawings), "The gap of the samples against what it may depend on; choose "
        "above. “After” is the gap with the causes in the model."
        + (f" {len(keep)} of {len(gap)} samples are drawn." if len(keep) < len(gap) else ""),
    )  # fmt: skip


Series = list[tuple[str, Array, str]]  # name, values, colour


def _scatter(
    across: tuple[Scale, Array], upwards: tuple[str, Series], slips: list[Slip]
) -> Drawing:
    axis, x = across
    y_title, series = upwards
    every = np.concatenate([values for _, values, _ in series])
    chart = Chart("", axis, scale(y_title, [*every], tight=True), width=430, height=270)
    for _, values, colour in series:
        chart.points([*x], [*values], colour, radius=2.0, opacity=0.7)
    mark(chart, slips)
    chart.legend([(name, colour) for name, _, colour in series])
    return chart.drawing


def _abscissas(channel: ChannelDiagnosis, keep: Index, log: Log) -> list[tuple[str, Scale, Array]]:
    """Return label, axis and values of each quantity to plot against."""
    observation, kept = channel.selection.observation, channel.selection.kept
    jitter = np.random.default_rng(0).uniform(-0.08, 0.08, len(keep))
    choices = []
    for name in _quantities(channel):
        unit, factor = quantity_unit(name)
        values: Array = observation.quantities[name][kept][keep] * factor
        if name.startswith("approach_"):
            values = values + jitter  # points at -1 and +1 would overlap
        title = quantity_title(name)
        axis = time_scale([*values], float(log.times()[0]), calendar=log.one_clock) if (
            title == TIME
        ) else _tight(f"{title} ({unit})" if unit else title, values)  # fmt: skip
        choices.append((title, axis, values))
    if not choices:
        rows: Array = np.asarray(observation.rows[kept][keep] + 1, dtype=np.float64)
        choices.append(("row of the log", _tight("row of the log", rows), rows))
    return choices


def _tight(title: str, values: Array) -> Scale:
    return scale(title, [*values], tight=True, zero=False)


def _ordinates(
    channel: ChannelDiagnosis, gaps: Series, count: int
) -> list[tuple[str, str, Series]]:
    """Return label, axis title and series: the largest coordinate, the norm, the others."""
    unit, factor = unit_of(channel.unit)
    names = channel.selection.observation.axes
    size = ("size of the gap", f"gap ({unit})",
            [(n, per_sample(g, count) * factor, c) for n, g, c in gaps])  # fmt: skip
    order = np.argsort(-np.asarray(channel.where.axes)[:count])
    single = [
        (f"along {names[i]}" if count == 3 else names[i], f"gap, {names[i]} ({unit})",
         [(n, g[:, i] * factor, c) for n, g, c in gaps])
        for i in order
    ]  # fmt: skip
    return [*single[:1], size, *single[1:]]


def arm_view(channel: ChannelDiagnosis, material: Material) -> blocks.View:
    """Return a 3-D view of the arm at a few poses and the TCP errors before and after."""
    selection = channel.selection
    gap, after = channel.gap[selection.kept][:, :3], channel.remaining[selection.kept][:, :3]
    rows = selection.observation.rows[selection.kept]
    q = material.log.require("actual_q", "target_q")[rows]
    tip = selection.observation.measured[selection.kept][:, :3] - gap  # predicted by the model
    keep = thinned(per_sample(gap, 3), ARROWS)
    rigid = material.model.without_terms()
    large = float(np.quantile(per_sample(gap, 3), 0.95))
    factor = round_factor(ARROW_LENGTH * reach(rigid) / max(large, 1e-9))
    chosen = spread_rows(tip, DRAWN_POSES)
    arms = [
        Path(skeleton(rigid, q[i]), EDGE if k else SOFT, 3.0 if k else 7.0, dots=True)
        for k, i in enumerate(chosen)
    ]  # fmt: skip
    errors = before_and_after(channel, gap, after)
    scene = Scene(
        "The arm with the TCP errors as arrows",
        (*base(reach(rigid)), *reversed(arms)),
        tuple(Arrows(tip[keep], tip[keep] + e[keep] * factor, colour) for _, e, colour in errors),
        (("arm", SOFT), *((f"error {name}", colour) for name, _, colour in errors)),
    )
    drawn = f" {len(keep)} of {len(gap)} samples are drawn." if len(keep) < len(gap) else ""
    return blocks.View(
        scene,
        f"The arm at {len(chosen)} of its poses; arrows point to the measured TCP, drawn "
        f"{factor:,.0f} times longer. Drag to turn; click, then scroll to zoom. "
        f"Base frame, grid of 0.1 or 0.25 m.{drawn}",
    )


def effect_tables(material: Material) -> list[blocks.Block]:
    """Return a table of the effects that were tried, per channel."""
    shown: list[blocks.Block] = [blocks.Paragraph(NOTE, "note")]
    for channel in material.diagnosis.channels:
        shown += [*channel_heading(material.diagnosis, channel), _table(channel)]
    return shown


def _table(channel: ChannelDiagnosis) -> blocks.Table:
    rows = [_cause_row(c) for c in channel.causes]
    others = sorted(channel.considered, key=lambda k: (not k.excited, -(k.shrink_alone or 0.0)))
    tied = {name for c in channel.causes for name in c.indistinguishable_from}
    rows += [_considered_row(k, k.effect in tied, bool(channel.causes)) for k in others]
    return blocks.Table(HEADS, rows, (2.2, 1.1, 1.1, 0.9, 3))


def _name(effect: str, joints: tuple[int, ...] = ()) -> blocks.Named:
    return blocks.Named(effect_title(effect), f", {joint_list(joints)}" if joints else "", effect)


def _cause_row(cause: Cause) -> list[blocks.Cell]:
    why = "needed: without it the gap is larger"
    if cause.shrink is not None:
        low, high = cause.shrink.interval
        why = (
            f"with it in the model the gap falls by a further {percent(cause.shrink.shrink)} "
            f"({percent(low)} to {percent(high)})"
        )
    if cause.indistinguishable_from:
        ties = listed([effect_title(n) for n in cause.indistinguishable_from], "or")
        why += f"; these data cannot separate it from: {ties}"
    tied = bool(cause.indistinguishable_from)
    verdict = (
        blocks.Badge("cause, tied", blocks.DOUBTFUL) if tied else blocks.Badge("cause", blocks.GOOD)
    )
    alone = blocks.Bar(cause.shrink_alone, percent(cause.shrink_alone))
    return [_name(cause.effect, cause.joints), verdict, alone, likelihood(cause.probability), why]


def _considered_row(considered: Considered, tied: bool, explained: bool) -> list[blocks.Cell]:
    """Return the row of an effect that is no cause; ``explained``: the channel has causes."""
    if considered.outcome is Outcome.NOT_EXCITED:
        why = f"this log does not show it; it needs {considered.needs}"
        return [_name(considered.effect), blocks.Badge("not excited", blocks.QUIET), "–", "–", why]
    if tied:
        verdict = blocks.Badge("tied", blocks.DOUBTFUL)
        why = "would explain these data as well as the cause named above"
    elif considered.outcome is Outcome.WITHDRAWN:
        verdict = blocks.Badge("withdrawn", blocks.DOUBTFUL)
        why = f"fitted well, but is not named as a cause: {considered_text(considered)}"
    else:
        verdict = blocks.Badge("no", blocks.QUIET)
        more = " beyond the causes above" if explained else ""
        why = f"explains too little{more} for the parameters it adds"
    alone: blocks.Cell = "–"
    if considered.shrink_alone is not None:
        alone = blocks.Bar(considered.shrink_alone, percent(considered.shrink_alone), EDGE)
    return [_name(considered.effect), verdict, alone, likelihood(considered.probability), why]
