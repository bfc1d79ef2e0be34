"""Axes of time: round times of day, or seconds from the start of the log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

from gapbridge.bridge.document.axes import MARGIN, Scale, scale
from gapbridge.bridge.document.local_time import DAY, TIME, clock, is_date, offset, zone

SHORT = 60.0  # s: a shorter log is shown in seconds
TICKS = 5  # most steps between ticks
ONE_DAY = 86400.0  # s
ROUND = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600, 43200)  # s


def time_scale(times: Sequence[float], start: float, *, calendar: bool = True) -> Scale:
    """Return a tight scale of timestamps, s, with round ticks.

    It is labelled with local times of day where the timestamps are dates and span a minute or
    more, else with seconds from ``start``, the timestamp of the log's first row. One offset from
    UTC, that of ``start``, is used throughout. Without ``calendar`` all are labelled with seconds.
    """
    low, high = min(times, default=start), max(times, default=start)
    dates = calendar and is_date(start)
    if dates and high - low >= SHORT:
        return _calendar(low, high, start)
    since = f"{clock(start, dated=True)} ({zone(start)})" if dates else "the first row"
    seconds = scale("", [low - start, high - start], tight=True, zero=False)
    return Scale(
        f"s from {since}", start + seconds.low, start + seconds.high,
        tuple(start + tick for tick in seconds.ticks), seconds.texts,
    )  # fmt: skip


def _calendar(low: float, high: float, start: float) -> Scale:
    ahead = offset(start)
    step = _step(high - low)
    margin = MARGIN * (high - low)
    low, high = low - margin, high + margin
    first, last = math.ceil((low + ahead) / step), math.floor((high + ahead) / step)
    local = [k * step for k in range(first, last + 1)]
    days = {datetime.fromtimestamp(t + ahead, UTC).date() for t in (low + margin, high - margin)}
    if step >= ONE_DAY:
        title, form = "date", DAY
    elif high - low > ONE_DAY:
        title, form = "date and time", "%m-%d %H:%M"
    else:
        title, form = f"time of day, {' to '.join(map(str, sorted(days)))}", TIME
    labels = tuple(datetime.fromtimestamp(t, UTC).strftime(form) for t in local)
    ticks = tuple(t - ahead for t in local)
    return Scale(f"{title} ({zone(start)})", low, high, ticks, labels)


def _step(span: float) -> float:
    for step in ROUND:
        if span <= TICKS * step:
            return float(step)
    days = scale("", [0.0, span / ONE_DAY], ticks=TICKS)
    return ONE_DAY * max(math.ceil(days.ticks[1]), 1)
