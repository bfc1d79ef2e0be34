"""Slips: when and how far, and the gap in each part of the log between them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from gapbridge.bridge.document.axes import Chart, Scale, scale
from gapbridge.bridge.document.blocks import (
    Block,
    Bullets,
    Cell,
    Heading,
    Paragraph,
    Pictures,
    Table,
)
from gapbridge.bridge.document.drawing import AFTER, BEFORE, VIOLET
from gapbridge.bridge.document.findings import moment_text, slip_text
from gapbridge.bridge.document.local_time import clock, is_date, zone
from gapbridge.bridge.document.numbers import unit_of, with_unit
from gapbridge.bridge.document.time_scale import time_scale
from gapbridge.bridge.report.labels import joint_list, listed, sentence
from gapbridge.bridge.report.material import Material, channel_heading, thinned
from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.diagnosis.finding import ChannelFinding, Slip
from gapbridge.core.diagnosis.noise_floor import own_coordinates
from gapbridge.core.effects import Reported

LABEL_LINES = 6  # of labels of slips, one below the other


@dataclass(frozen=True)
class Moment:
    """Slips between the same two rows of the log."""

    slips: tuple[Slip, ...]  # joints may slip together

    @property
    def time(self) -> float:
        """Return when, as in the log: s, or the row."""
        return self.slips[0].term.values[-1]

    @property
    def label(self) -> str:
        """Return what slipped, in a few words."""
        joints = tuple(s.term.site.joint for s in self.slips if s.term.site.joint is not None)
        target = ["target"] if len(joints) < len(self.slips) else []
        return listed([*([joint_list(joints)] if joints else []), *target])


@dataclass(frozen=True)
class Stretch:
    """The log between two slips: rms per coordinate of its samples, in the channel's unit."""

    title: str
    samples: int
    without: float
    with_causes: float


def slip_findings(diagnosis: Diagnosis) -> list[ChannelFinding]:
    """Return the findings that are slips."""
    channel_findings = [f for f in diagnosis.findings if isinstance(f, ChannelFinding)]
    return [f for f in channel_findings if isinstance(f.fact, Slip)]


def slips_of(diagnosis: Diagnosis, channel: ChannelDiagnosis) -> list[Slip]:
    """Return a channel's slips in order of time."""
    found = [
        f.fact for f in slip_findings(diagnosis)
        if f.channel == channel.channel and isinstance(f.fact, Slip)
    ]  # fmt: skip
    return sorted(found, key=lambda slip: (slip.before, slip.term.site.joint or 0))


def moment_of(parameter: Reported, diagnosis: Diagnosis) -> str:
    """Return when a parameter that is a time says that something slipped."""
    facts = [f.fact for f in slip_findings(diagnosis)]
    if any(isinstance(fact, Slip) and not fact.timed for fact in facts):
        return f"after row {int(parameter.value)}"
    return clock(parameter.value, dated=True)


def moments(slips: list[Slip]) -> list[Moment]:
    """Return the moments of slips; those between the same two rows are one."""
    together: dict[float, list[Slip]] = {}
    for slip in slips:
        together.setdefault(slip.before, []).append(slip)
    return [Moment(tuple(at_once)) for at_once in together.values()]


def sample_sizes(channel: ChannelDiagnosis) -> tuple[Array, Array]:
    """Return each kept sample's rms per coordinate (n,), without and with the causes.

    With the causes it is held out where that is possible; the squares' means are those of the
    channel's figures.
    """
    kept, count = channel.selection.kept, own_coordinates(channel.selection.observation)

    def rms(values: Array) -> Array:
        return np.asarray(np.sqrt(np.mean(values[kept][:, :count] ** 2, axis=1)))

    held_out = channel.held_out
    return rms(channel.gap), rms(channel.remaining) if held_out is None else held_out


def sample_times(channel: ChannelDiagnosis) -> Array:
    """Return the kept samples' times (n,), s, or numbers of rows."""
    observation = channel.selection.observation
    times = observation.rows + 1.0 if observation.times is None else observation.times
    return np.asarray(times, dtype=float)[channel.selection.kept]


def stretches(channel: ChannelDiagnosis, slips: list[Slip]) -> list[Stretch]:
    """Return the gap in each part of the log that begins or ends with a slip."""
    found = moments(slips)
    if not found:
        return []
    sizes, times = sample_sizes(channel), sample_times(channel)
    ends = [-np.inf, *(moment.time for moment in found), np.inf]
    parts = []
    for title, (begin, end) in zip(_titles(found), pairwise(ends), strict=True):
        inside = (times > begin) & (times <= end)
        without, with_causes = (
            float(np.sqrt(np.mean(size[inside] ** 2))) if inside.any() else float("nan")
            for size in sizes
        )
        parts.append(Stretch(title, int(inside.sum()), without, with_causes))
    return parts


def _titles(found: list[Moment]) -> list[str]:
    """Return the title of each part of the log between the moments."""
    slips = [moment.slips[0] for moment in found]
    if slips[0].session:
        first = f"before {slips[0].session}"
        middle = [f"from {a.session}, before {b.session}" for a, b in pairwise(slips)]
        return [first, *middle, f"from {slips[-1].session} on"]
    first = f"until {moment_text(slips[0], slips[0].before)}"
    middle = [
        f"{moment_text(a, a.after)} to {moment_text(b, b.before)}" for a, b in pairwise(slips)
    ]
    return [first, *middle, f"from {moment_text(slips[-1], slips[-1].after)} on"]


def slip_texts(diagnosis: Diagnosis, channel: ChannelDiagnosis) -> list[tuple[str, str]]:
    """Return for each slip what moved, how far and when; and the gap before and after it."""
    slips = slips_of(diagnosis, channel)
    parts, unit = stretches(channel, slips), channel.unit
    held_out = "" if channel.held_out is None else " (held out)"
    texts = []
    for k, moment in enumerate(moments(slips)):
        before, after = parts[k], parts[k + 1]
        gap = (
            f"gap (rms) before it {with_unit(before.without, unit)}, after it "
            f"{with_unit(after.without, unit)}; with the causes in the model{held_out} "
            f"{with_unit(before.with_causes, unit)} and {with_unit(after.with_causes, unit)}"
        )
        texts += [(slip_text(slip), gap) for slip in moment.slips]
    return texts


def advice(slips: list[Slip]) -> str:
    """Return what to do about slips in the workshop."""
    what = Moment(tuple(slips)).label
    joints = {slip.term.site.joint is not None for slip in slips}
    checked = ["a collision, a belt, a coupling or an encoder"] if True in joints else []
    checked += ["a target that was knocked or is loose"] if False in joints else []
    return (
        f"Find out why it slipped ({what}): {listed(checked, 'or')}. It can slip again, and a cell "
        "with the slip in it is right only until then."
    )


def clock_note(slips: list[Slip]) -> str:
    """Return which time zone the times of slips are in; empty where they are no times of day."""
    dated = [s for s in slips if s.timed and not s.session and is_date(s.first)]
    return f"Times of day are local ({zone(dated[0].first)})." if dated else ""


def answered(diagnosis: Diagnosis) -> list[Block]:
    """Return the slips of all channels for the summary."""
    texts = [
        " ".join(map(sentence, pair))
        for c in diagnosis.channels
        for pair in slip_texts(diagnosis, c)
    ]
    if not texts:
        return []
    slips = [slip for c in diagnosis.channels for slip in slips_of(diagnosis, c)]
    note = clock_note(slips)
    more = [Paragraph(note, "note")] if note else []
    return [Heading("What slipped, and when"), Bullets(tuple(texts)), *more]


def slip_section(material: Material) -> list[Block]:
    """Return the gap of each part of the log and over time, for channels with slips."""
    shown: list[Block] = []
    for channel in material.diagnosis.channels:
        slips = slips_of(material.diagnosis, channel)
        if slips:
            shown += channel_heading(material.diagnosis, channel)
            shown += [_table(channel, slips), _picture(channel, slips)]
    return shown


def _table(channel: ChannelDiagnosis, slips: list[Slip]) -> Table:
    rows: list[list[Cell]] = [
        [part.title, str(part.samples), with_unit(part.without, channel.unit),
         with_unit(part.with_causes, channel.unit)]
        for part in stretches(channel, slips)
    ]  # fmt: skip
    held_out = "" if channel.held_out is None else ", held out"
    heads = ("part of the log", "samples", "gap (rms) without the causes",
             f"with the causes{held_out}")  # fmt: skip
    return Table(heads, rows, (2.4, 0.8, 1.4, 1.4))


def _picture(channel: ChannelDiagnosis, slips: list[Slip]) -> Pictures:
    without, with_causes = sample_sizes(channel)
    times, (name, factor) = sample_times(channel), unit_of(channel.unit)
    keep = thinned(without)
    series = [("without the causes", without * factor, BEFORE),
              ("with them", with_causes * factor, AFTER)]  # fmt: skip
    highest = max(float(values.max()) for _, values, _ in series)
    across = log_scale(slips[0], times)
    chart = Chart("", across, scale(f"gap per coordinate, {name}", [0.0, 1.1 * highest]),
                  width=640, height=270)  # fmt: skip
    ends = [across.low, *(moment.time for moment in moments(slips)), across.high]
    for (_, values, colour), size in zip(series, ("without", "with_causes"), strict=True):
        chart.points([*times[keep]], [*values[keep]], colour, radius=2.0, opacity=0.7)
        for part, edges in zip(stretches(channel, slips), pairwise(ends), strict=True):
            level = factor * float(getattr(part, size))
            if np.isfinite(level):
                chart.line([*edges], [level, level], colour, width=1.4)
    mark(chart, slips)
    chart.legend([(label, colour) for label, _, colour in series])
    frame = (
        " The fit of the instrument's frame to all rows spreads a slip over the whole log where "
        "the causes are not in the model."
        if channel.selection.observation.nuisance.size
        else ""
    )
    note = f" {len(keep)} of {len(times)} samples are drawn." if len(keep) < len(times) else ""
    return Pictures(
        (chart.drawing,),
        "Every sample; horizontal lines: the rms of each part of the log; dashed: a slip, drawn "
        f"between the last row before it and the first after it.{frame}{note}",
    )


def log_scale(slip: Slip, times: Array) -> Scale:
    """Return the axis of a log's samples: time where it has any, else its rows."""
    if slip.timed:
        return time_scale([*times], slip.first, calendar=not slip.session)
    return scale("row of the log", [*times], tight=True, zero=False)


def mark(chart: Chart, slips: list[Slip]) -> None:
    """Draw a labelled vertical line at each moment of a chart over time."""
    for k, moment in enumerate(moments(slips)):
        chart.upright(moment.time, f"slip: {moment.label}", VIOLET, line=k % LABEL_LINES)


def mark_rows(chart: Chart, channel: ChannelDiagnosis, slips: list[Slip]) -> None:
    """Draw the same in a chart over the rows of the log, counted from 1."""
    rows, times = channel.selection.observation.rows, channel.selection.observation.times
    if times is None:
        return
    for k, moment in enumerate(moments(slips)):
        after = int(np.searchsorted(times, moment.time, side="right"))
        row = 1.0 + 0.5 * float(rows[max(after - 1, 0)] + rows[min(after, len(rows) - 1)])
        chart.upright(row, f"slip: {moment.label}", VIOLET, line=k % LABEL_LINES)
