"""The answer: three sentences and one picture."""

from __future__ import annotations

from typing import Any

from bridge.report.fragment import (
    AFTER, BEFORE, EXPLAINED, FLOOR, LEFT, Figure, badge, figure_block, html_of, paragraph,
)  # fmt: skip
from bridge.report.material import Material, chosen_channel, shares
from bridge.report.words import (
    CHANNELS, VERDICTS, effect_words, joints_words, likelihood, listed, percent, quantity_words,
    told, unit_of,
)  # fmt: skip
from core.diagnosis.cause import Cause
from core.diagnosis.diagnosis import ChannelDiagnosis

KINDS = {"no_gap": "good", "explained": "good", "partly_explained": "doubtful",
         "unexplained": "bad"}  # fmt: skip
ROW = 190  # pixels of picture a channel


def section(material: Material) -> str:
    """Return the section: verdict, three sentences, the picture, a line for further channels."""
    diagnosis = material.diagnosis
    main = chosen_channel(diagnosis)
    word = badge(VERDICTS[diagnosis.verdict], KINDS[diagnosis.verdict])
    parts = [f'<p class="verdict">{html_of(word)}</p>']
    parts.append(paragraph(" ".join(sentences(main)), "lead"))
    for channel in diagnosis.channels:
        if channel is not main:
            parts.append(paragraph(f"{CHANNELS[channel.channel]}: {one_line(channel)}"))
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
    tie = f" – or, these data cannot tell, {listed(ties, 'or')}" if ties else ""
    return f"{effect_words(cause.effect)}{where}{tie}"


def _size(channel: ChannelDiagnosis) -> str:
    unit, what = channel.unit, {
        "position": "The tool is off by", "wrench": "The measured force is off by",
        "tracking": "The joints are off their command by", "torque": "The joint torques are off by",
    }[channel.channel]  # fmt: skip
    per = "joint" if channel.channel in ("tracking", "torque") else "axis"
    floor = channel.noise_floor_rms
    noise = "" if floor is None else f"; measurement noise makes {told(floor, unit)} of it"
    if channel.verdict == "no_gap":
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
    share = shares(channel).explained
    sure = likelihood(min(c.probability for c in channel.causes))
    many = len(channel.causes) > 1
    return (
        f"Cause{'s' if many else ''}: {words}; with {'them' if many else 'it'} in the model the "
        f"gap falls to {told(_after(channel), channel.unit)} on measurements the fit did not see "
        f"({percent(share)} of its energy explained; {sure} sure)."
    )


def _left(channel: ChannelDiagnosis) -> str:
    if channel.structured:
        names = [quantity_words(name) for name, share in channel.depends_on[:3] if share > 0.01]
        on = f" It depends on {listed(names)}." if names else ""
        return (
            f"{told(channel.unexplained_rms, channel.unit)} stays unexplained, more than noise.{on}"
        )
    if channel.verdict == "no_gap":
        return "Nothing needs to be changed on account of this log."
    return "What remains looks like measurement noise, with no structure left in it."


def _after(channel: ChannelDiagnosis) -> float:
    held = channel.remaining_rms_held_out
    return channel.remaining_rms if held is None else held


def picture(channels: tuple[ChannelDiagnosis, ...]) -> Figure:
    """Return the one picture: gap, remainder and noise, and the shares, channel by channel."""
    traces: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"showlegend": False, "barmode": "stack",
                              "margin": {"l": 132, "r": 24, "t": 8, "b": 8}}  # fmt: skip
    rows = len(channels)
    for i, channel in enumerate(channels):
        top, step = 1 - i / rows, 1 / rows
        for j, (low, high) in enumerate(((0.36, 0.86), (0.10, 0.24))):
            axis = "" if 2 * i + j == 0 else str(2 * i + j + 1)
            layout[f"xaxis{axis}"] = {"anchor": f"y{axis}", "visible": False, "fixedrange": True,
                                      "rangemode": "tozero"}  # fmt: skip
            layout[f"yaxis{axis}"] = {"anchor": f"x{axis}", "fixedrange": True, "automargin": False,
                                      "autorange": "reversed", "ticks": "",
                                      "domain": [top - step * (1 - low), top - step * (1 - high)]}  # fmt: skip
            traces += (_bars, _stack)[j](channel, axis)
        layout["xaxis" + ("" if i == 0 else str(2 * i + 1))]["range"] = [0, _reach(channel)]
        notes.append({
            "text": f"<b>{CHANNELS[channel.channel]}</b>", "xref": "paper", "yref": "paper",
            "x": 0, "y": top - step * 0.02, "xanchor": "left", "yanchor": "top", "showarrow": False,
        })  # fmt: skip
    layout["annotations"] = notes
    return Figure(
        traces, layout,
        "Gap per coordinate (rms) before and after the found causes are put into the model, on "
        "measurements the fit did not see, beside the noise; below, how the gap divides up.",
        height=ROW * rows + 10,
    )  # fmt: skip


def _reach(channel: ChannelDiagnosis) -> float:
    factor = unit_of(channel.unit)[1]
    return 1.28 * factor * max(channel.gap_rms, _after(channel), channel.noise_floor_rms or 0.0)


def _bars(channel: ChannelDiagnosis, axis: str) -> list[dict[str, Any]]:
    given = [("before", channel.gap_rms, BEFORE), ("after", _after(channel), AFTER)]
    if channel.noise_floor_rms is not None:
        given.append(("noise", channel.noise_floor_rms, FLOOR))
    factor = unit_of(channel.unit)[1]
    return [{
        "type": "bar", "orientation": "h", "xaxis": f"x{axis}", "yaxis": f"y{axis}",
        "y": [name for name, _, _ in given], "x": [v * factor for _, v, _ in given],
        "text": [told(v, channel.unit) for _, v, _ in given], "textposition": "outside",
        "cliponaxis": False, "marker": {"color": [c for _, _, c in given]}, "hoverinfo": "y+text",
    }]  # fmt: skip


def _stack(channel: ChannelDiagnosis, axis: str) -> list[dict[str, Any]]:
    part = shares(channel)
    given = [("explained", part.explained, EXPLAINED), ("noise", part.noise, FLOOR),
             ("unexplained", part.unexplained, LEFT)]  # fmt: skip
    return [
        {
            "type": "bar", "orientation": "h", "xaxis": f"x{axis}", "yaxis": f"y{axis}",
            "y": ["share"], "x": [share], "marker": {"color": colour}, "name": name,
            "text": [f"{name} {percent(share)}" if share > 0.12 else ""], "hoverinfo": "text",
            "hovertext": [f"{name} {percent(share)}"], "textposition": "inside",
            "insidetextanchor": "middle", "textangle": 0,
        }
        for name, share, colour in given
    ]  # fmt: skip
