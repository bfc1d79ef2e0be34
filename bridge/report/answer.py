"""The answer: three sentences and one picture."""

from __future__ import annotations

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.drawing import (
    AFTER,
    BAD_DOT,
    BEFORE,
    EDGE,
    INK,
    LIMIT,
    ON_BAR,
    SOFT,
    Drawing,
    Rectangle,
    Text,
)
from gapbridge.bridge.report.labels import (
    CHANNELS,
    VERDICTS,
    effect_title,
    joint_list,
    likelihood,
    listed,
    percent,
    quantity_title,
    with_unit,
)  # fmt: skip
from gapbridge.bridge.report.material import Material, after, chosen_channel, shares, unexplained
from gapbridge.core.diagnosis.causes import Cause
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis

KINDS = {
    Verdict.NO_GAP: blocks.GOOD,
    Verdict.EXPLAINED: blocks.GOOD,
    Verdict.PARTLY_EXPLAINED: blocks.DOUBTFUL,
    Verdict.UNEXPLAINED: blocks.BAD,
}
CAPTION = (
    "Gap per coordinate (rms) before and after the found causes are put into the model, on "
    "measurements the fit did not see, beside the noise. Below, how the gap divides up; squares "
    "are what add up, so the shares are of the squared gap."
)
WIDTH, LABELS = 390.0, 152.0  # of the drawing, and beside the bars
ROW, BAR = 24.0, 15.0


def answer(material: Material) -> list[blocks.Block]:
    """Return the blocks; further channels have a line each."""
    diagnosis = material.diagnosis
    main = chosen_channel(diagnosis)
    verdict = blocks.Badge(VERDICTS[diagnosis.verdict], KINDS[diagnosis.verdict])
    others = [
        blocks.Paragraph(f"{CHANNELS[c.channel]}: {one_line(c)}")
        for c in diagnosis.channels
        if c is not main
    ]
    return [
        blocks.Verdict(verdict, " ".join(sentences(main))), *others,
        blocks.Heading("What to do now"), blocks.Bullets(tuple(next_steps(diagnosis))),
        blocks.Pictures(tuple(picture(c) for c in diagnosis.channels), CAPTION),
    ]  # fmt: skip


def next_steps(diagnosis: Diagnosis) -> list[str]:
    """Return what the user does next, most urgent first."""
    causes = [cause for c in diagnosis.channels for cause in c.causes]
    steps = []
    if diagnosis.findings:
        steps.append(
            "Read the findings under Data quality first: where one of them is a mistake in log or "
            "cell, correct it and diagnose again."
        )
    if causes:
        steps.append(
            "Write the causes into a new cell with --apply NEW_CELL, then diagnose a log with "
            "other poses against that cell: its gap should be that of “after”."
        )
    elif diagnosis.verdict is Verdict.NO_GAP:
        steps.append("Nothing: use the cell as it is. Diagnose again after a change to the arm.")
    if any(c.structured or c.verdict is Verdict.UNEXPLAINED for c in diagnosis.channels):
        steps.append(
            "Do not compensate what no effect explains. Look at what the remaining gap depends on "
            "(“Where the gap lies”) and at the arm there: wear, a loose part, cables, the "
            "instrument's mounting."
        )
    if diagnosis.next_measurements:
        open_ = any(cause.indistinguishable_from for cause in causes)
        what = "To decide between the causes that these data cannot separate, measure" if open_ \
            else "To answer the open questions, measure"  # fmt: skip
        steps.append(f"{what} the poses under “What to measure next” and add them to the log.")
    return steps


def sentences(channel: ChannelDiagnosis) -> list[str]:
    """Return three sentences: how large the gap is, what causes it, what is left."""
    return [_size(channel), _causes(channel), _left(channel)]


def one_line(channel: ChannelDiagnosis) -> str:
    """Return one sentence on a channel that is not the main one."""
    if channel.verdict is Verdict.NO_GAP:
        return f"no gap; {with_unit(channel.gap_rms, channel.unit)} is what noise makes."
    return f"{_causes(channel)} {_left(channel)}"


def cause_title(cause: Cause) -> str:
    """Return a cause in plain words with its joints."""
    where = f" ({joint_list(cause.joints)})" if cause.joints else ""
    ties = [effect_title(name) for name in cause.indistinguishable_from]
    tie = f" – or, these data cannot distinguish between, {listed(ties, 'or')}" if ties else ""
    return f"{effect_title(cause.effect)}{where}{tie}"


def _size(channel: ChannelDiagnosis) -> str:
    unit, what = channel.unit, {
        "position": "The tool is off by", "wrench": "The measured force is off by",
        "tracking": "The joints are off their command by", "torque": "The joint torques are off by",
    }[channel.channel]  # fmt: skip
    per = "joint" if channel.channel in ("tracking", "torque") else "axis"
    floor = channel.noise_floor_rms
    noise = "" if floor is None else f"; measurement noise makes {with_unit(floor, unit)} of it"
    if floor is not None and floor >= channel.gap_rms:
        noise = f", no more than the measurement noise of {with_unit(floor, unit)}"
    elif channel.verdict is Verdict.NO_GAP:
        noise = "" if floor is None else f", and noise alone makes {with_unit(floor, unit)}"
    return (
        f"{what} {with_unit(channel.gap_rms, unit)} per {per} (rms over {channel.samples} samples, "
        f"{with_unit(channel.gap_max, unit)} at worst){noise}."
    )


def _causes(channel: ChannelDiagnosis) -> str:
    if not channel.causes:
        if channel.verdict is Verdict.NO_GAP:
            return "Model and measurement agree: no effect is needed to explain the difference."
        return (
            "No known effect explains it: something is going on that is not in the catalogue, "
            "and no known effect is blamed for it."
        )
    causes = listed([cause_title(c) for c in channel.causes])
    fall = 1 - after(channel) / max(channel.gap_rms, 1e-300)
    sure = likelihood(min(c.probability for c in channel.causes))
    many = len(channel.causes) > 1
    left = with_unit(after(channel), channel.unit)
    change = (
        f"the gap falls by {percent(fall)} to {left}"
        if fall > 0
        else (f"the gap does not fall (it is {left})")
    )
    return (
        f"Cause{'s' if many else ''}: {causes}; with {'them' if many else 'it'} in the model "
        f"{change} on measurements that the fit did not see ({sure} sure).{elsewhere(channel)}"
    )


def elsewhere(channel: ChannelDiagnosis) -> str:
    """Return what to expect where nothing was fitted: never only the flattering figure."""
    found, unit = channel.generalisation, channel.unit
    parts = []
    if found.new_region is not None:
        parts.append(f"{with_unit(found.new_region, unit)} in a new region of joint space")
    if found.new_session is not None:
        parts.append(f"{with_unit(found.new_session, unit)} in a new session")
    session = "" if found.new_session is not None else (
        " One session does not show what a new one brings."
    )  # fmt: skip
    return (f" Expect {listed(parts)}." if parts else "") + session


def _left(channel: ChannelDiagnosis) -> str:
    if channel.structured:
        names = [quantity_title(name) for name, share in channel.depends_on[:3] if share > 0.01]
        on = f" It depends on {listed(names)}." if names else ""
        size = with_unit(unexplained(channel), channel.unit)
        return f"{size} stays unexplained, more than noise.{on}"
    if channel.verdict is Verdict.NO_GAP:
        return "Nothing needs to be changed on account of this log."
    return "What remains looks like measurement noise, with no structure left in it."


def picture(channel: ChannelDiagnosis) -> Drawing:
    """Return the bars of one channel, and the shares below them."""
    bars = [("before" if channel.causes else "gap", channel.gap_rms, BEFORE)]
    if channel.causes:
        bars.append(("after", after(channel), AFTER))
    if channel.noise_floor_rms is not None:
        bars.append(("noise", channel.noise_floor_rms, EDGE))
    title = CHANNELS[channel.channel]
    drawing = Drawing(WIDTH, 30 + ROW * (len(bars) + 1) + 10, f"{title}: gap before and after")
    drawing.add(Text(0, 14, title, 13, INK, bold=True))
    longest = max(value for _, value, _ in bars) or 1.0
    for i, (name, value, colour) in enumerate(bars):
        y = 28 + ROW * i
        drawing.add(Text(0, y + 11.5, name, 11.5, SOFT))
        drawing.add(Text(LABELS - 8, y + 11.5, with_unit(value, channel.unit), 11.5, INK, "end"))
        drawing.add(Rectangle(LABELS, y, (WIDTH - LABELS) * value / longest, BAR, colour))
    _shares(drawing, channel, 34 + ROW * len(bars))
    return drawing


def _shares(drawing: Drawing, channel: ChannelDiagnosis, y: float) -> None:
    part, x = shares(channel), LABELS
    drawing.add(Text(0, y + 11.5, "shares", 11.5, SOFT))
    for name, share, colour in (
        ("explained", part.explained, LIMIT),
        ("noise", part.noise, EDGE),
        ("unexplained", part.unexplained, BAD_DOT),
    ):
        wide = (WIDTH - LABELS) * share
        text = f"{name} {percent(share)}"
        drawing.add(Rectangle(x, y, wide, BAR, colour, text))
        if wide > 6.2 * len(text):
            drawing.add(Text(x + wide / 2, y + 11.3, text, 10.5, ON_BAR, "middle"))
        x += wide
