"""Axes of time: labels that can be read, at round local times, for every log."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.bridge.document.axes import Chart, scale, tick_labels
from gapbridge.bridge.document.drawing import Text
from gapbridge.bridge.document.local_time import clock, zone
from gapbridge.bridge.document.time_scale import time_scale

START = 1796000000.0  # 2026-11-30 00:53:20 UTC


@pytest.fixture
def in_zone(monkeypatch):
    """Return a function that sets the time zone of this process until the test ends."""

    def set_zone(name: str) -> None:
        monkeypatch.setenv("TZ", name)
        time.tzset()

    yield set_zone
    monkeypatch.undo()
    time.tzset()


@given(st.floats(-1e10, 1e10), st.floats(1e-3, 1e9), st.booleans())
def test_neighbouring_ticks_never_read_alike(low: float, span: float, tight: bool) -> None:
    axis = scale("", [low, low + span], tight=tight, zero=False)
    assert len(axis.ticks) >= 2
    for (a, b), (one, other) in zip(pairwise(axis.ticks), pairwise(axis.texts), strict=True):
        read, next_read = (float(text.replace("−", "-")) for text in (one, other))
        assert read != next_read
        assert next_read - read == pytest.approx(b - a, rel=3e-3)


@given(st.floats(0.0, 9e9), st.floats(1.0, 1e9), st.booleans())
def test_neighbouring_ticks_of_time_never_read_alike(
    start: float, span: float, calendar: bool
) -> None:
    axis = time_scale([start, start + span / 3, start + span], start, calendar=calendar)
    assert 2 <= len(axis.ticks) <= 7
    assert all(axis.low <= tick <= axis.high for tick in axis.ticks)
    assert len(axis.labels) == len(axis.ticks)
    assert all(a != b for a, b in pairwise(axis.labels))


def test_a_log_of_two_hours_has_times_of_day() -> None:
    axis = time_scale([START, START + 7590], START)
    assert axis.labels == ("01:00:00", "01:30:00", "02:00:00", "02:30:00", "03:00:00")
    assert axis.title == "time of day, 2026-11-30 (UTC)"
    assert [datetime.fromtimestamp(t, UTC).strftime("%H:%M:%S") for t in axis.ticks] == [
        *axis.labels
    ]


def test_a_log_of_days_has_dates() -> None:
    assert time_scale([START, START + 3.4e5], START).labels[:2] == ("2026-11-30", "2026-12-01")
    labels = time_scale([START, START + 1.2e5], START).labels
    assert labels == ("11-30 00:00", "11-30 12:00", "12-01 00:00")


@pytest.mark.parametrize(("start", "title"), [
    (START, "s from 2026-11-30 00:53:20 (UTC)"), (5321.7, "s from the first row"),
])  # fmt: skip
def test_a_short_log_and_one_without_a_date_have_seconds_from_their_first_row(start, title) -> None:
    axis = time_scale([start, start + 8.0], start)
    assert axis.title == title
    assert axis.labels == ("0", "2", "4", "6", "8")
    assert axis.ticks[1] == start + 2.0


def test_joined_clocks_have_no_times_of_day() -> None:
    axis = time_scale([START, START + 7200], START, calendar=False)
    assert (axis.title, axis.labels[1]) == ("s from the first row", "2000")


@pytest.mark.parametrize(
    ("time", "text"), [(730.0, "730 s"), (12346408.25, "12346408.25 s"), (0.1 + 0.2, "0.3 s")]
)
def test_seconds_are_exact_also_months_after_a_controllers_start(time: float, text: str) -> None:
    assert clock(time) == text


def test_times_are_local_and_name_their_zone(in_zone) -> None:
    in_zone("Asia/Kolkata")
    assert clock(START) == "06:23:20"
    assert zone(START) == "UTC+05:30"
    axis = time_scale([START, START + 7590], START)
    assert axis.labels[0] == "06:30:00"
    assert axis.title == "time of day, 2026-11-30 (UTC+05:30)"
    assert clock(axis.ticks[0]) == axis.labels[0]


def test_an_hour_that_comes_twice_is_not_labelled_twice(in_zone) -> None:
    in_zone("Europe/Berlin")
    autumn = 1792890000.0  # 2026-10-25 01:00 UTC, when summer time ends
    axis = time_scale([autumn - 7200, autumn + 7200], autumn - 7200)
    assert len({*axis.labels}) == len(axis.labels)
    assert "(UTC+02:00)" in axis.title


def test_large_numbers_keep_the_digits_that_differ() -> None:
    assert tick_labels([1.796e9, 1.796002e9]) == ("1796000000", "1796002000")
    assert tick_labels([1.0, 1.00005, 1.0001]) == ("1", "1.00005", "1.0001")
    assert tick_labels([0.0, 1e5, 2e5]) == ("0", "100000", "200000")


@pytest.mark.parametrize("span", [20.0, 7000.0, 3e5])
def test_labels_of_times_do_not_touch(span: float) -> None:
    axis = time_scale([START, START + span], START)
    chart = Chart("", axis, scale("mm", [0.0, 1.0]), width=430)
    places = [
        s
        for s in chart.drawing.shapes
        if isinstance(s, Text) and s.text in axis.labels and s.anchor == "middle"
    ]
    for a, b in pairwise(places):
        assert b.x - a.x > 6.4 * (len(a.text) + len(b.text)) / 2
