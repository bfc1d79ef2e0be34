"""Summary of a diagnosis: verdict, three sentences, next steps, and a chart of the gap."""

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
from gapbridge.bridge.document.numbers import likelihood, percent, with_unit
from gapbridge.bridge.report.labels import (
    CHANNELS,
    VERDICTS,
    effect_title,
    joint_list,
    listed,
    quantity_title,
)
from gapbridge.bridge.report.material import Material, after, chosen_channel, shares, unexplained
from gapbridge.bridge.report.slips import advice, answered, slips_of
from gapbridge.core.diagnosis.causes import Cause, Outcome
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis

KINDS = {
    Verdict.NO_GAP: blocks.GOOD,
    Verdict.EXPLAINED: blocks.GOOD,
    Verdict.PARTLY_EXPLAINED: blocks.DOUBTFUL,
    Verdict.UNEXPLAINED: blocks.BAD,
}
CAPTION = (
    "Gap per coordinate (rms) before and after the causes are added to the model, on held-out "
    "measurements, and the measurement noise. Below, the shares of the squared gap (squares add "
    "up)."
)
WIDTH, LABELS = 390.0, 152.0  # of the drawing, and of the labels left of the bars
ROW, BAR = 24.0, 15.0


def answer(material: Material) -> list[blocks.Block]:
    """Return the summary of the main channel in full, and a line for each other channel."""
    diagnosis = material.diagnosis
    main = chosen_channel(diagnosis)
    verdict = blocks.Badge(VERDICTS[diagnosis.verdict], KINDS[diagnosis.verdict])
    others = [
        blocks.Paragraph(f"{CHANNELS[c.channel]}: {one_line(c)}")
        for c in diagnosis.channels
        if c is not main
    ]
    return [
        blocks.Verdict(verdict, " ".join(sentences(main))), *others, *answered(diagnosis),
        blocks.Heading("What to do now"), blocks.Bullets(tuple(next_steps(diagnosis))),
        blocks.Pictures(tuple(picture(c) for c in diagnosis.channels), CAPTION),
    ]  # fmt: skip


def next_steps(diagnosis: Diagnosis) -> list[str]:
    """Return recommended next steps, most urgent first."""
    causes = [cause for c in diagnosis.channels for cause in c.causes]
    steps = []
    slipped = [slip for c in diagnosis.channels for slip in slips_of(diagnosis, c)]
    if len(diagnosis.findings) > len(slipped):
        steps.append(
            "Read the findings under Data quality first: where one is a mistake in the log or the "
            "cell, correct it and diagnose again."
        )
    if slipped:
        steps.append(advice(slipped))
    if causes:
        steps.append(
            "Write the causes into a new cell with --apply NEW_CELL, then diagnose a log of other "
            "poses with that cell: its gap should be about that shown as “after”."
        )
    elif diagnosis.verdict is Verdict.NO_GAP:
        steps.append("None: use the cell as it is. Diagnose again after a change to the arm.")
    if any(c.structured or c.verdict is Verdict.UNEXPLAINED for c in diagnosis.channels):
        steps.append(
            "Do not compensate what no effect explains. Check what the remaining gap depends on "
            "(“Where the gap lies”), and the arm there: wear, a loose part, cables, the mounting "
            "of the instrument."
        )
    if diagnosis.next_measurements:
        tied = any(cause.indistinguishable_from for cause in causes)
        purpose = "To decide between the causes that these data cannot separate, measure" if tied \
            else "To answer the open questions, measure"  # fmt: skip
        steps.append(f"{purpose} the poses under “What to measure next” and add them to the log.")
    return steps


def sentences(channel: ChannelDiagnosis) -> list[str]:
    """Return three sentences: size of the gap, its causes, and what remains."""
    return [_size(channel), _causes(channel), _remaining(channel)]


def one_line(channel: ChannelDiagnosis) -> str:
    """Return one sentence on a channel that is not the main one."""
    if channel.verdict is Verdict.NO_GAP:
        return f"no gap; {with_unit(channel.gap_rms, channel.unit)} is within the noise."
    return f"{_causes(channel)} {_remaining(channel)}"


def cause_title(cause: Cause) -> str:
    """Return the title of a cause with its joints and the effects that it is tied with."""
    where = f" ({joint_list(cause.joints)})" if cause.joints else ""
    ties = [effect_title(name) for name in cause.indistinguishable_from]
    tie = f" (or {listed(ties, 'or')}; these data cannot distinguish them)" if ties else ""
    return f"{effect_title(cause.effect)}{where}{tie}"


def _size(channel: ChannelDiagnosis) -> str:
    unit, what = channel.unit, {
        "position": "The TCP error is", "wrench": "The measured force is off by",
        "tracking": "The following error is", "torque": "The joint torques are off by",
    }[channel.channel]  # fmt: skip
    per = "joint" if channel.channel in ("tracking", "torque") else "axis"
    floor = channel.noise_floor_rms
    noise = "" if floor is None else f"; measurement noise accounts for {with_unit(floor, unit)}"
    if floor is not None and floor >= channel.gap_rms:
        noise = f", no more than the measurement noise of {with_unit(floor, unit)}"
    elif channel.verdict is Verdict.NO_GAP:
        noise = "" if floor is None else f"; noise alone would give {with_unit(floor, unit)}"
    return (
        f"{what} {with_unit(channel.gap_rms, unit)} per {per} (rms over {channel.samples} samples, "
        f"{with_unit(channel.gap_max, unit)} at worst){noise}."
    )


def _causes(channel: ChannelDiagnosis) -> str:
    if not channel.causes:
        if channel.verdict is Verdict.NO_GAP:
            return "Model and measurement agree: no effect is needed to explain the difference."
        fits = [k.effect for k in channel.considered if k.outcome is Outcome.WITHDRAWN]
        if fits:
            titles = listed([effect_title(name) for name in fits], "or")
            return (
                f"No effect is named as its cause. It may be one that fits but did not pass every "
                f"check: {titles} (“Which effect causes it” gives the reasons)."
            )
        return (
            "No effect of the catalogue explains it, so none is named as a cause: its cause is not "
            "in the catalogue."
        )
    causes = listed([cause_title(c) for c in channel.causes])
    reduction = 1 - after(channel) / max(channel.gap_rms, 1e-300)
    probability = likelihood(min(c.probability for c in channel.causes))
    many = len(channel.causes) > 1
    remaining = with_unit(after(channel), channel.unit)
    change = (
        f"the gap falls by {percent(reduction)} to {remaining}"
        if reduction > 0
        else (f"the gap does not fall (it is {remaining})")
    )
    return (
        f"Cause{'s' if many else ''}: {causes}; with {'them' if many else 'it'} in the model "
        f"{change} on held-out measurements (probability {probability}).{elsewhere(channel)}"
    )


def elsewhere(channel: ChannelDiagnosis) -> str:
    """Return the expected gap in a new region and in a new session, which exceed the fit's."""
    found, unit = channel.generalisation, channel.unit
    parts = []
    if found.new_region is not None:
        parts.append(f"{with_unit(found.new_region, unit)} in a new region of joint space")
    if found.new_session is not None:
        parts.append(f"{with_unit(found.new_session, unit)} in a new session")
    session = "" if found.new_session is not None else (
        " One session does not show how sessions differ."
    )  # fmt: skip
    return (f" Expect {listed(parts)}." if parts else "") + session


def _remaining(channel: ChannelDiagnosis) -> str:
    if channel.structured:
        names = [quantity_title(name) for name, share in channel.depends_on[:3] if share > 0.01]
        on = f" It depends on {listed(names)}." if names else ""
        size = with_unit(unexplained(channel), channel.unit)
        return f"{size} remains unexplained, more than noise.{on}"
    if channel.verdict is Verdict.NO_GAP:
        return "This log calls for no change."
    return "What remains has no structure and is consistent with measurement noise."


def picture(channel: ChannelDiagnosis) -> Drawing:
    """Return a chart of one channel: bars of the gap, and its shares below."""
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
        width = (WIDTH - LABELS) * share
        text = f"{name} {percent(share)}"
        drawing.add(Rectangle(x, y, width, BAR, colour, text))
        if width > 6.2 * len(text):
            drawing.add(Text(x + width / 2, y + 11.3, text, 10.5, ON_BAR, "middle"))
        x += width
