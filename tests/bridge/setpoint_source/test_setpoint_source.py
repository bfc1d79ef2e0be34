"""Where setpoints come from: own target, trajectory, planner's lines."""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from bridge.cell.sections import SetpointSettings
from bridge.setpoint_source import make_source
from bridge.setpoint_source.source import Source, SourceDryError
from bridge.setpoint_source.target import TargetSource
from bridge.setpoint_source.tcp import TcpSource
from bridge.setpoint_source.trajectory import TrajectorySource
from core.errors import InputError, LogError, RunError

HERE = np.array([0.1, 0.2, 0.3])


def trajectory(tmp_path: Path, text: str) -> Source:
    (tmp_path / "way.csv").write_text(text, encoding="utf-8")
    settings = SetpointSettings(source="trajectory", file=Path("way.csv"))
    return make_source(settings, 3, True, tmp_path)


WAY = """timestamp,target_q_0,target_q_1,target_q_2
5.0,0.0,0.0,1.0
5.5,1.0,-1.0,1.0
6.0,1.0,-1.0,2.0
"""


def test_each_name_gives_its_source(tmp_path: Path) -> None:
    assert isinstance(trajectory(tmp_path, WAY), TrajectorySource)
    made = make_source(SetpointSettings(source="target"), 3, True, tmp_path)
    assert isinstance(made, TargetSource)
    assert isinstance(make_source(SetpointSettings(source="tcp"), 3, True, tmp_path), TcpSource)


def test_a_trajectory_is_replayed_at_the_controllers_clock_and_held_at_its_end(
    tmp_path: Path,
) -> None:
    source = trajectory(tmp_path, WAY)
    assert source.first(HERE) == pytest.approx([0, 0, 1])
    source.begin(1000.0, HERE)
    assert source.sample(1000.0, HERE) == pytest.approx([0, 0, 1])
    assert source.sample(1000.25, HERE) == pytest.approx([0.5, -0.5, 1])
    assert source.sample(1000.5, HERE) == pytest.approx([1, -1, 1])
    assert source.sample(1000.875, HERE) == pytest.approx([1, -1, 1.75])
    assert not source.ended
    assert source.sample(1001.0, HERE) == pytest.approx([1, -1, 2])
    assert source.ended
    assert source.sample(2000.0, HERE) == pytest.approx([1, -1, 2])


def test_a_trajectory_can_be_begun_again(tmp_path: Path) -> None:
    source = trajectory(tmp_path, WAY)
    source.begin(10.0, HERE)
    source.sample(99.0, HERE)
    source.begin(200.0, HERE)
    assert not source.ended
    assert source.sample(200.25, HERE) == pytest.approx([0.5, -0.5, 1])


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("5.5,", "4.5,", "row 3, column timestamp"),
        ("-1.0,1.0\n", "nan,1.0\n", "column target_q_1"),
        ("target_q_2", "other", "target_q"),
    ],
)
def test_a_bad_trajectory_is_one_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=words) as refusal:
        trajectory(tmp_path, WAY.replace(old, new, 1))
    assert "\n" not in str(refusal.value)


def test_a_missing_trajectory_is_named(tmp_path: Path) -> None:
    settings = SetpointSettings(source="trajectory", file=Path("nowhere.csv"))
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        make_source(settings, 3, True, tmp_path)


def test_the_own_target_is_where_the_arm_stood_or_what_its_program_wants(tmp_path: Path) -> None:
    standing = make_source(SetpointSettings(), 3, True, tmp_path)
    standing.begin(0.0, HERE)
    assert standing.sample(1.0, HERE + 0.1) == pytest.approx(HERE)
    riding = make_source(SetpointSettings(), 3, False, tmp_path)
    riding.begin(0.0, HERE)
    assert riding.sample(1.0, HERE + 0.1) == pytest.approx(HERE + 0.1)


@pytest.fixture
def feed() -> Iterator[TcpSource]:
    source = TcpSource(SetpointSettings(source="tcp", port=0, timeout=0.15), 3, True, Path())
    source.open()
    yield source
    source.close()


def planner(feed: TcpSource) -> socket.socket:
    found = socket.create_connection(("127.0.0.1", feed.port), timeout=2)
    found.settimeout(2)
    return found


def first_of(feed: TcpSource, seconds: float = 1.0) -> np.ndarray | None:
    until = time.monotonic() + seconds
    while (found := feed.first(HERE)) is None and time.monotonic() < until:
        time.sleep(0.002)
    return found


@pytest.mark.parametrize("line", ["0.1,0.2,0.3", '{"q": [0.1, 0.2, 0.3]}', " 0.1 , 0.2,0.3 \r"])
def test_a_line_is_a_setpoint(line: str, feed: TcpSource) -> None:
    with planner(feed) as socket_:
        assert feed.first(HERE) is None
        socket_.sendall(line.encode() + b"\n")
        assert first_of(feed) == pytest.approx([0.1, 0.2, 0.3])
        feed.begin(0.0, HERE)
        assert feed.sample(0.002, HERE) == pytest.approx([0.1, 0.2, 0.3])


def test_joints_glide_between_lines(feed: TcpSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"0,0,0\n")
        first_of(feed)
        feed.begin(0.0, np.zeros(3))
        time.sleep(0.06)
        socket_.sendall(b"0.06,0,0\n")
        seen, until = [], time.monotonic() + 0.08
        while time.monotonic() < until:
            seen.append(feed.sample(0.0, HERE)[0])
            time.sleep(0.002)
    assert seen[-1] == pytest.approx(0.06)
    assert np.diff(seen).min() >= 0
    assert np.diff(seen).max() < 0.03
    assert any(0.01 < v < 0.05 for v in seen)


def test_a_feed_that_falls_silent_is_dry_and_may_come_back(feed: TcpSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"0,0,0\n")
        first_of(feed)
        feed.begin(0.0, HERE)
        time.sleep(0.2)
        with pytest.raises(SourceDryError, match="no line for"):
            feed.sample(0.0, HERE)
        assert feed.first(HERE) is None
        socket_.sendall(b"0,0,0.5\n")
        assert first_of(feed) == pytest.approx([0, 0, 0.5])


@pytest.mark.parametrize(
    "line", ["1,2", "1,2,3,4", "1,2,nan", "1,2,inf", "a,b,c", '{"p": 1}', '{"q": 5}', "{", "[" * 99]
)
def test_a_bad_line_is_answered_and_not_used(line: str, feed: TcpSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(line.encode() + b"\n")
        assert first_of(feed, 0.1) is None
        assert socket_.recv(200).startswith(b"error: ")
        assert feed.bad_lines == 1
        socket_.sendall(json.dumps({"q": [0, 0, 0]}).encode() + b"\n")
        assert first_of(feed) is not None


def test_a_line_without_end_does_not_fill_the_memory(feed: TcpSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"1" * 20_000)
        until = time.monotonic() + 1
        while not feed.bad_lines and time.monotonic() < until:
            feed.first(HERE)
        assert feed.bad_lines >= 1
        assert len(feed._buffer) <= 4096


def test_a_second_planner_is_turned_away_and_the_next_one_is_not(feed: TcpSource) -> None:
    with planner(feed) as one:
        one.sendall(b"0,0,0\n")
        first_of(feed)
        with planner(feed) as two:
            feed.first(HERE)
            time.sleep(0.02)
            feed.first(HERE)
            assert b"another planner" in two.recv(200)
    feed.first(HERE)
    with planner(feed) as three:
        three.sendall(b"0,0,0.1\n")
        until = time.monotonic() + 1
        while (found := feed.first(HERE)) is None or found[2] != 0.1:
            assert time.monotonic() < until
            time.sleep(0.002)


def test_a_taken_port_is_one_line(feed: TcpSource) -> None:
    settings = SetpointSettings(source="tcp", port=feed.port)
    with pytest.raises(RunError, match="cannot listen on"):
        TcpSource(settings, 3, True, Path()).open()


def test_a_feed_that_others_could_reach_is_refused() -> None:
    with pytest.raises(ValueError, match="loopback"):
        SetpointSettings(source="tcp", host="0.0.0.0")
