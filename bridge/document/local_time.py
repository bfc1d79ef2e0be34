"""Timestamps as local time of day, or as seconds where they are not those of a calendar."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta, timezone

SINCE_1970 = (1e9, 1e11)  # s: between these a timestamp is a date
DAY = "%Y-%m-%d"
TIME = "%H:%M:%S"


def is_date(time: float) -> bool:
    """Return whether a timestamp, s, counts from 1970."""
    return SINCE_1970[0] <= time < SINCE_1970[1]


def clock(time: float, dated: bool = False) -> str:
    """Return seconds since 1970 as local time of day, ``dated`` with its date; else seconds."""
    if not is_date(time):
        return f"{round(time, 4):.15g} s"  # also weeks after a controller's start
    return datetime.fromtimestamp(time).strftime(f"{DAY} {TIME}" if dated else TIME)


def day(time: float) -> date:
    """Return the local date of seconds since 1970."""
    return datetime.fromtimestamp(time).date()


def offset(time: float) -> float:
    """Return how far local time was ahead of UTC, s."""
    ahead = datetime.fromtimestamp(time, UTC).astimezone().utcoffset()
    return 0.0 if ahead is None else ahead.total_seconds()


def zone(time: float) -> str:
    """Return the local time zone as "UTC" or "UTC+01:00"."""
    return str(timezone(timedelta(seconds=offset(time))))
