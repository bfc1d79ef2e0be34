"""The answer: three sentences and one picture."""

from __future__ import annotations

from gapbridge.bridge.report.answer_picture import picture
from gapbridge.bridge.report.fragment import badge, figure_block, html_of, paragraph
from gapbridge.bridge.report.material import Material, after, chosen_channel, unexplained
from gapbridge.bridge.report.words import (
    CHANNELS,
    VERDICTS,
    effect_words,
    joints_words,
    likelihood,
    listed,
    percent,
    quantity_words,
    told,
)  # fmt: skip
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.result import Cause

KINDS = {"no_gap": "good", "explained": "good", "partly_explained": "doubtful",
         "unexplained": "bad"}  # fmt: skip


def section(material: Material) -> str:
    """Return the section: verdict, three sentences, the picture, a line for further channels."""
    diagnosis = material.diagnosis
    main = chosen_channel(diagnosis)
    word = badge(VERDICTS[diagnosis.verdict], KINDS[diagnosis.verdict])
    parts = [f'<p class="verdict">{html_of(word)}</p>']
    parts.append(paragraph(" ".join(sentences(main)), "lead"))
    parts += [
        paragraph(f"{CHANNELS[c.channel]}: {one_line(c)}")
        for c in diagnosis.channels
        if c is not main
    ]
    parts.append(figure_block(picture(diagnosis.channels)))
    return "".join(parts)


def sentences(channel: ChannelDiagnosis) -> list[str]:
    """Return three sentences: how large the gap is, what causes it, what is left."""
    return [_size(channel), _causes(channel), _left(channel)]


def one_line(channel: ChannelDiagnosis) -> str:
    """Return what is to be said of a channel that is not the main one."""
    if channel.verdict == "no_gap":
        return f"no gap; {told(channel.gap_rms, channel.unit)} is what noise makes."
    return f"{_causes(channel)} {_left(channel)}"


def cause_words(cause: Cause) -> str:
    """Return a cause in plain words with its joints."""
    where = f" ({joints_words(cause.joints)})" if cause.joints else ""
    ties = [effect_words(name) for name in cause.indistinguishable_from]
    tie = f" – or, these data cannot distinguish between, {listed(ties, 'or')}" if ties else ""
    return f"{effect_words(cause.effect)}{where}{tie}"


def _size(channel: ChannelDiagnosis) -> str:
    unit, what = channel.unit, {
        "position": "The tool is off by", "wrench": "The measured force is off by",
        "tracking": "The joints are off their command by", "torque": "The joint torques are off by",
    }[channel.channel]  # fmt: skip
    per = "joint" if channel.channel in ("tracking", "torque") else "axis"
    floor = channel.noise_floor_rms
    noise = "" if floor is None else f"; measurement noise makes {told(floor, unit)} of it"
    if floor is not None and floor >= channel.gap_rms:
        noise = f", no more than the measurement noise of {told(floor, unit)}"
    elif channel.verdict == "no_gap":
        noise = "" if floor is None else f", and noise alone makes {told(floor, unit)}"
    return (
        f"{what} {told(channel.gap_rms, unit)} per {per} (rms over {channel.samples} samples, "
        f"{told(channel.gap_max, unit)} at worst){noise}."
    )


def _causes(channel: ChannelDiagnosis) -> str:
    if not channel.causes:
        if channel.verdict == "no_gap":
            return "Model and measurement agree: no effect is needed to explain the difference."
        return (
            "No known effect explains it: something is going on that is not in the catalogue, "
            "and no known effect is blamed for it."
        )
    words = listed([cause_words(c) for c in channel.causes])
    fall = 1 - after(channel) / max(channel.gap_rms, 1e-300)
    sure = likelihood(min(c.probability for c in channel.causes))
    many = len(channel.causes) > 1
    left = told(after(channel), channel.unit)
    change = (
        f"the gap falls by {percent(fall)} to {left}"
        if fall > 0
        else (f"the gap does not fall (it is {left})")
    )
    return (
        f"Cause{'s' if many else ''}: {words}; with {'them' if many else 'it'} in the model "
        f"{change} on measurements that the fit did not see ({sure} sure).{elsewhere(channel)}"
    )


def elsewhere(channel: ChannelDiagnosis) -> str:
    """Return what to expect where nothing was fitted: never only the flattering figure."""
    found, unit = channel.elsewhere, channel.unit
    parts = []
    if found.new_region is not None:
        parts.append(f"{told(found.new_region, unit)} in a new region of joint space")
    if found.new_session is not None:
        parts.append(f"{told(found.new_session, unit)} in a new session")
    session = "" if found.new_session is not None else (
        " One session does not show what a new one brings."
    )  # fmt: skip
    return (f" Expect {listed(parts)}." if parts else "") + session


def _left(channel: ChannelDiagnosis) -> str:
    if channel.structured:
        names = [quantity_words(name) for name, share in channel.depends_on[:3] if share > 0.01]
        on = f" It depends on {listed(names)}." if names else ""
        return f"{told(unexplained(channel), channel.unit)} stays unexplained, more than noise.{on}"
    if channel.verdict == "no_gap":
        return "Nothing needs to be changed on account of this log."
    return "What remains looks like measurement noise, with no structure left in it."
