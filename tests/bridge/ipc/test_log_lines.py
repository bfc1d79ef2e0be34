"""Events as lines of JSON: one line each, no secret in any."""

import io
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.bridge.ipc.log_lines import JsonLines, log_line

TEXTS = st.dictionaries(st.text(max_size=8), st.text(max_size=20) | st.floats() | st.none())


def test_a_transition_reports_what_led_where():
    found = json.loads(
        log_line(
            {
                "kind": "transition", "time": 1767268800.25, "monotonic": 3.0, "sequence": 7,
                "from": "COMPENSATING", "to": "FAULT", "cause": "write failed", "detail": "refused",
            }
        )
    )  # fmt: skip
    assert found["time"] == "2026-01-01T12:00:00.250Z"
    assert found["level"] == "error"
    assert found["event"] == "transition"
    assert found["message"] == "compensating -> fault (write failed): refused"
    assert found["sequence"] == 7
    assert "monotonic" not in found


@pytest.mark.parametrize(
    ("event", "level"),
    [
        ({"kind": "refused", "detail": "no"}, "error"),
        ({"kind": "recorder", "paused": "disk full", "detail": "d"}, "warning"),
        ({"kind": "side", "side": "web", "detail": "ended with 1"}, "warning"),
        ({"kind": "failure", "detail": "the link is lost"}, "error"),
        ({"kind": "slip", "joints": [3], "size": 0.01, "detail": "joint 3"}, "error"),
        ({"kind": "warning", "what": "unexpected_force", "detail": "d"}, "warning"),
        ({"kind": "degraded", "what": "ft_sensor", "detail": "silent"}, "warning"),
        ({"kind": "degraded", "what": "", "detail": "the sensor is back"}, "info"),
        ({"kind": "dropped", "what": "nan", "detail": "d"}, "warning"),
        ({"kind": "link", "what": "stale", "detail": "d"}, "warning"),
        ({"kind": "control", "detail": "armed"}, "info"),
    ],
)
def test_levels_follow_how_grave_it_is(event, level):
    assert json.loads(log_line(event))["level"] == level


def test_no_secret_and_no_cell_text_reaches_a_log():
    line = log_line(
        {
            "kind": "configuration", "time": 1.0, "text": "link: {password: hunter2}",
            "token": "hunter2",
            "link": {"password": "hunter2", "options": [{"api_key": "hunter2"}]},
        }
    )  # fmt: skip
    assert "hunter2" not in line
    assert json.loads(line)["link"]["options"] == [{"api_key": "(hidden)"}]


@given(TEXTS)
def test_any_event_is_one_line_that_reads_back(event):
    line = log_line({**event, "time": 5.0})
    assert "\n" not in line
    assert isinstance(json.loads(line), dict)


def test_a_stream_that_is_gone_stops_nothing():
    stream = io.StringIO()
    lines = JsonLines(stream)
    lines.emit({"kind": "note", "detail": "a\nb"})
    assert json.loads(stream.getvalue())["message"] == "a\nb"
    stream.close()
    lines.emit({"kind": "note"})
