"""The one picture of the answer: gap, remainder and noise, and how the gap divides up."""

from __future__ import annotations

from typing import Any

from gapbridge.bridge.report.fragment import AFTER, BEFORE, EXPLAINED, FLOOR, LEFT, Figure
from gapbridge.bridge.report.material import after, shares
from gapbridge.bridge.report.words import CHANNELS, percent, told, unit_of
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis

ROW = 190  # pixels of picture a channel
LABELS = 150  # pixels beside the bars


def picture(channels: tuple[ChannelDiagnosis, ...]) -> Figure:
    """Return the one picture: gap, remainder and noise, and the shares, channel by channel."""
    traces: list[dict[str, Any]] = []
    notes: list[dict[str, Any]] = []
    layout: dict[str, Any] = {"showlegend": False, "barmode": "stack",
                              "margin": {"l": LABELS, "r": 8, "t": 8, "b": 8}}  # fmt: skip
    rows = len(channels)
    for i, channel in enumerate(channels):
        top, step = 1 - i / rows, 1 / rows
        for j, (low, high) in enumerate(((0.36, 0.86), (0.10, 0.24))):
            axis = "" if 2 * i + j == 0 else str(2 * i + j + 1)
            domain = [top - step * (1 - low), top - step * (1 - high)]
            reach = (_reach(channel), 1.02)[j]
            layout |= _axes(axis, domain, reach)
            traces += (_bars, _stack)[j](channel, axis)
        notes.append(_title(CHANNELS[channel.channel], top - step * 0.02))
    layout["annotations"] = notes
    return Figure(
        traces, layout,
        "Gap per coordinate (rms) before and after the found causes are put into the model, on "
        "measurements the fit did not see, beside the noise. Below, how the gap divides up; "
        "squares are what add up, so the shares are of the squared gap.",
        height=ROW * rows + 10,
    )  # fmt: skip


def _axes(axis: str, domain: list[float], reach: float) -> dict[str, Any]:
    return {
        f"xaxis{axis}": {
            "anchor": f"y{axis}", "visible": False, "fixedrange": True, "range": [0, reach],
        },
        f"yaxis{axis}": {
            "anchor": f"x{axis}", "fixedrange": True, "automargin": False, "ticks": "",
            "autorange": "reversed", "showgrid": False, "domain": domain,
        },
    }  # fmt: skip


def _title(text: str, at: float) -> dict[str, Any]:
    return {
        "text": f"<b>{text}</b>", "xref": "paper", "yref": "paper", "x": 0, "y": at,
        "xanchor": "left", "xshift": 4 - LABELS, "yanchor": "top", "showarrow": False,
    }  # fmt: skip


def _reach(channel: ChannelDiagnosis) -> float:
    factor = unit_of(channel.unit)[1]
    most = max(channel.gap_rms, channel.noise_floor_rms or 0.0)
    return 1.02 * factor * max(most, after(channel) if channel.causes else 0.0)


def _bars(channel: ChannelDiagnosis, axis: str) -> list[dict[str, Any]]:
    given = [("before" if channel.causes else "gap", channel.gap_rms, BEFORE)]
    if channel.causes:
        given.append(("after", after(channel), AFTER))
    if channel.noise_floor_rms is not None:
        given.append(("noise", channel.noise_floor_rms, FLOOR))
    factor = unit_of(channel.unit)[1]
    return [{
        "type": "bar", "orientation": "h", "xaxis": f"x{axis}", "yaxis": f"y{axis}",
        "y": [f"{name}  <b>{told(v, channel.unit)}</b>" for name, v, _ in given],
        "x": [v * factor for _, v, _ in given], "hoverinfo": "y",
        "marker": {"color": [c for _, _, c in given]},
    }]  # fmt: skip


def _stack(channel: ChannelDiagnosis, axis: str) -> list[dict[str, Any]]:
    part = shares(channel)
    given = [("explained", part.explained, EXPLAINED), ("noise", part.noise, FLOOR),
             ("unexplained", part.unexplained, LEFT)]  # fmt: skip
    return [
        {
            "type": "bar", "orientation": "h", "xaxis": f"x{axis}", "yaxis": f"y{axis}",
            "y": ["shares"], "x": [share], "marker": {"color": colour}, "name": name,
            "text": [f"{name} {percent(share)}" if share > 0.12 else ""], "hoverinfo": "text",
            "hovertext": [f"{name} {percent(share)}"], "textposition": "inside",
            "insidetextanchor": "middle", "textangle": 0,
        }
        for name, share, colour in given
    ]  # fmt: skip
