"""The one picture of the answer: gap, remainder and noise, and how the gap divides up."""

from __future__ import annotations

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
from gapbridge.bridge.report.labels import CHANNELS, percent, with_unit
from gapbridge.bridge.report.material import after, shares
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis

CAPTION = (
    "Gap per coordinate (rms) before and after the found causes are put into the model, on "
    "measurements the fit did not see, beside the noise. Below, how the gap divides up; squares "
    "are what add up, so the shares are of the squared gap."
)
WIDTH, LABELS = 380.0, 116.0  # of the drawing, and beside the bars
ROW, BAR = 24.0, 15.0


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
