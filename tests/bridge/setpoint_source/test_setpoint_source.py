"""Where setpoints come from: own target, trajectory, planner's lines."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clock_by_hand import ByHand
from patience import PATIENCE

from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.run_settings import settings_of
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.control_socket import Peer
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.bridge.setpoint_source.interpolator import MAX_INTERVAL
from gapbridge.bridge.setpoint_source.planner import PlannerSource
from gapbridge.bridge.setpoint_source.source import Source, SourceContext, SourceDryError
from gapbridge.bridge.setpoint_source.target import TargetSource
from gapbridge.bridge.setpoint_source.tcp import TcpSource
from gapbridge.bridge.setpoint_source.trajectory import TrajectorySource
from gapbridge.core.errors import CellError, InputError, LogError, RunError
from gapbridge.drivers.clock import SYSTEM

HERE = np.array([0.1, 0.2, 0.3])


def trajectory(tmp_path: Path, text: str) -> Source:
    (tmp_path / "way.csv").write_text(text, encoding="utf-8")
    settings = SetpointSettings(source="trajectory", file=Path("way.csv"))
    return make_source(settings, 3, True, tmp_path, clock=SYSTEM)


WAY = """timestamp,target_q_0,target_q_1,target_q_2
5.0,0.0,0.0,1.0
5.5,1.0,-1.0,1.0
6.0,1.0,-1.0,2.0
"""


def test_each_name_gives_its_source(tmp_path: Path) -> None:
    assert isinstance(trajectory(tmp_path, WAY), TrajectorySource)
    made = make_source(SetpointSettings(source="target"), 3, True, tmp_path, clock=SYSTEM)
    assert isinstance(made, TargetSource)
    for name, kind in (("planner", PlannerSource), ("tcp", TcpSource)):
        settings = SetpointSettings(source=name, token_file=tmp_path / "token")
        assert type(make_source(settings, 3, True, tmp_path, clock=SYSTEM)) is kind


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
    ("old", "new", "phrase"),
    [
        ("5.5,", "4.5,", "row 3, column timestamp"),
        ("-1.0,1.0\n", "nan,1.0\n", "column target_q_1"),
        ("target_q_2", "other", "target_q"),
    ],
)
def test_a_bad_trajectory_is_one_line(old: str, new: str, phrase: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=phrase) as refusal:
        trajectory(tmp_path, WAY.replace(old, new, 1))
    assert "\n" not in str(refusal.value)


def test_a_missing_trajectory_is_named(tmp_path: Path) -> None:
    settings = SetpointSettings(source="trajectory", file=Path("nowhere.csv"))
    with pytest.raises(InputError, match=r"nowhere\.csv"):
        make_source(settings, 3, True, tmp_path, clock=SYSTEM)


def test_the_own_target_is_where_the_arm_stood_or_what_its_program_wants(tmp_path: Path) -> None:
    standing = make_source(SetpointSettings(), 3, True, tmp_path, clock=SYSTEM)
    standing.begin(0.0, HERE)
    assert standing.sample(1.0, HERE + 0.1) == pytest.approx(HERE)
    riding = make_source(SetpointSettings(), 3, False, tmp_path, clock=SYSTEM)
    riding.begin(0.0, HERE)
    assert riding.sample(1.0, HERE + 0.1) == pytest.approx(HERE + 0.1)


TOKEN = "5f0b6ad1c2e94d7788f1a3b0c6d2e4f7"
RATE = 500.0  # Hz


@pytest.fixture
def feed(tmp_path: Path) -> Iterator[PlannerSource]:
    settings = SetpointSettings(source="planner", socket=tmp_path / "p.sock", timeout=0.15)
    source = PlannerSource(SourceContext(settings, 3, True, Path(), RATE, SYSTEM))
    source.open()
    yield source
    source.close()


@pytest.fixture
def tcp(tmp_path: Path) -> Iterator[TcpSource]:
    token = tmp_path / "token"
    token.write_text(TOKEN + "\n")
    token.chmod(0o600)
    settings = SetpointSettings(source="tcp", token_file=token, port=0, timeout=0.15)
    source = TcpSource(SourceContext(settings, 3, True, Path(), RATE, SYSTEM))
    source.open()
    yield source
    source.close()


def planner(feed: PlannerSource) -> socket.socket:
    if isinstance(feed, TcpSource):
        found = socket.create_connection(("127.0.0.1", feed.port), timeout=PATIENCE)
    else:
        found = socket.socket(socket.AF_UNIX)
        found.connect(str(feed.settings.socket))
    found.settimeout(PATIENCE)
    return found


def first_of(feed: PlannerSource) -> np.ndarray | None:
    until = time.monotonic() + PATIENCE
    while (found := feed.first(HERE)) is None and time.monotonic() < until:
        time.sleep(0.002)
    return found


def closed_by(feed: PlannerSource, link: socket.socket) -> tuple[bytes, bool]:
    """Look as the loop does until the feed closes; returns its answer, and if a setpoint came."""
    received, setpoint_came = b"", False
    link.settimeout(0.002)
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        setpoint_came |= feed.first(HERE) is not None
        try:
            piece = link.recv(4096)
        except TimeoutError:
            continue
        except ConnectionResetError:
            return received, setpoint_came
        if not piece:
            return received, setpoint_came
        received += piece
    raise AssertionError(f"not closed within 20 s; received {received!r}")


def answer(link: socket.socket) -> bytes:
    """Return all that comes until the other side closes."""
    found = b""
    try:
        while piece := link.recv(4096):
            found += piece
    except ConnectionResetError:
        pass
    return found


@pytest.mark.parametrize("line", ["0.1,0.2,0.3", '{"q": [0.1, 0.2, 0.3]}', " 0.1 , 0.2,0.3 \r"])
def test_a_line_is_a_setpoint(line: str, feed: PlannerSource) -> None:
    with planner(feed) as socket_:
        assert feed.first(HERE) is None
        socket_.sendall(line.encode() + b"\n")
        assert first_of(feed) == pytest.approx([0.1, 0.2, 0.3])
        feed.begin(0.0, HERE)
        assert feed.sample(0.002, HERE) == pytest.approx([0.1, 0.2, 0.3])


def test_joints_are_interpolated_between_lines(feed: PlannerSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"0,0,0\n")
        first_of(feed)
        feed.begin(0.0, np.zeros(3))
        time.sleep(0.06)
        socket_.sendall(b"0.06,0,0\n")
        seen, begun = [0.0], [time.monotonic()]
        ended = begun.copy()
        while seen[-1] < 0.06 and begun[-1] - begun[0] < PATIENCE:
            begun.append(time.monotonic())
            seen.append(feed.sample(0.0, HERE)[0])
            ended.append(time.monotonic())
            time.sleep(0.002)
    assert seen[-1] == pytest.approx(0.06)
    steps, most = np.diff(seen), np.array(ended[1:]) - begun[:-1]  # the lines ask for 1 rad/s
    assert (steps >= 0).all()
    assert (steps <= most + 1.0 / RATE + 1e-6).all()  # a segment begins a cycle before its line


def test_a_feed_that_falls_silent_is_dry_and_may_come_back(feed: PlannerSource) -> None:
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


GOOD = json.dumps({"q": [0, 0, 0]}).encode() + b"\n"
BAD = ["1,2", "1,2,3,4", "1,2,nan", "1,2,inf", "a,b,c", '{"p": 1}', '{"q": 5}', "{", "[" * 99,
       "[" * 3000, '{"q":' + "[" * 3000, '{"q": "123"}', '{"q": [true, 0, 0]}',
       '{"q": ["1", 0, 0]}', '{"q": [1' + "0" * 400 + ", 0, 0]}", '{"q": {"1": 0, "2": 0, "3": 0}}',
       "GET / HTTP/1.1", "POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n", "\x16\x03\x01"]  # fmt: skip


@pytest.mark.parametrize("line", BAD)
def test_the_first_bad_line_ends_the_connection_and_nothing_after_it_counts(
    line: str, feed: PlannerSource
) -> None:
    with planner(feed) as socket_:
        socket_.sendall(line.encode() + b"\n" + 5 * GOOD)
        reply, setpoint_came = closed_by(feed, socket_)
        assert not setpoint_came
        assert reply.startswith(b"error: ")
        assert reply.count(b"\n") == 1
    assert feed.refused == 1
    with planner(feed) as socket_:  # and the feed is free for another one
        socket_.sendall(GOOD)
        assert first_of(feed) is not None


def test_a_line_without_end_does_not_fill_the_memory(feed: PlannerSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"1" * 20_000)
        reply, setpoint_came = closed_by(feed, socket_)
        assert b"a line without end" in reply
        assert not setpoint_came


def test_more_lines_than_the_robot_has_cycles_end_the_connection(feed: PlannerSource) -> None:
    with planner(feed) as socket_:
        begun, sent = time.monotonic(), 0
        socket_.settimeout(0.01)
        with pytest.raises((BrokenPipeError, ConnectionResetError)):  # noqa: PT012
            while time.monotonic() - begun < 20.0:
                with contextlib.suppress(TimeoutError):
                    socket_.sendall(50 * b"0,0,0\n")
                    sent += 50
                for _ in range(8):
                    feed.first(HERE)
        took = time.monotonic() - begun
        assert b"the robot's rate" in answer(socket_)
    assert sent >= 2 * RATE  # what a loop that was away for a moment finds is taken
    assert took < 20.0


def test_a_cycle_takes_a_few_lines_however_many_there_are(feed: PlannerSource) -> None:
    with planner(feed) as socket_:
        socket_.sendall(b"".join(f"{k},0,0\n".encode() for k in range(100)))
        time.sleep(0.02)
        seen = []
        for _ in range(30):
            found = feed.first(HERE)
            assert found is not None
            seen.append(found[0])
    assert seen[0] <= 8
    assert seen[-1] == 99
    assert np.diff(seen).max() <= 8


def test_a_second_planner_is_turned_away_and_the_next_one_is_not(feed: PlannerSource) -> None:
    with planner(feed) as one:
        one.sendall(b"0,0,0\n")
        first_of(feed)
        with planner(feed) as two:
            two.sendall(b"0,0,9\n")
            until = time.monotonic() + 0.3
            while time.monotonic() < until:
                one.sendall(b"0,0,0\n")
                assert feed.first(HERE) == pytest.approx(np.zeros(3))
                time.sleep(0.01)
            assert answer(two) == b"error: another planner is connected\n"
    for _ in range(20):  # takes what the first one sent, and sees it leave
        feed.first(HERE)
    with planner(feed) as three:
        three.sendall(b"0,0,0.1\n")
        until = time.monotonic() + PATIENCE
        while (found := feed.first(HERE)) is None or found[2] != 0.1:
            assert time.monotonic() < until
            time.sleep(0.002)


def test_connections_that_say_nothing_keep_no_planner_out(feed: PlannerSource) -> None:
    silent = []
    for _ in range(12):
        silent.append(planner(feed))
        feed.first(HERE)
    with planner(feed) as one:
        one.sendall(b"0,0,0.2\n")
        assert first_of(feed) == pytest.approx([0, 0, 0.2])
    assert b"too many connections" in answer(silent[0])
    for link in silent:
        link.close()


def test_one_that_fell_silent_gives_way_and_hears_of_it(feed: PlannerSource) -> None:
    with planner(feed) as one, planner(feed) as two:
        one.sendall(b"0,0,0\n")
        first_of(feed)
        time.sleep(0.2)  # longer than the timeout: the feed is dry
        two.sendall(b"0,0,0.3\n")
        assert first_of(feed) == pytest.approx([0, 0, 0.3])
        assert b"another planner has taken the feed" in closed_by(feed, one)[0]


def test_the_socket_is_its_owners_and_goes_with_the_source(feed: PlannerSource) -> None:
    path = feed.settings.socket
    assert path is not None
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    feed.close()
    assert not path.exists()


@pytest.mark.parametrize("away", [0.015, 0.05])
def test_in_a_motion_another_planner_goes_on_from_where_the_last_one_was(
    tmp_path: Path, away: float
) -> None:
    """One that was started anew would take the armed arm to its own start at full speed."""
    clock, cycle = ByHand(), 1.0 / RATE
    settings = SetpointSettings(source="planner", socket=tmp_path / "p.sock")
    source = PlannerSource(SourceContext(settings, 3, True, Path(), RATE, clock))
    source.open()
    with contextlib.closing(source):
        with planner(source) as one:
            one.sendall(GOOD)
            assert source.first(HERE) is not None
            source.begin(0.0, HERE)
            assert source.sample(0.0, HERE) == pytest.approx(np.zeros(3))
        clock.now += cycle
        assert source.sample(0.0, HERE) == pytest.approx(np.zeros(3))
        with planner(source) as two:
            two.sendall(f"{away},0,0\n".encode())
            seen = [0.0]
            for _ in range(round(settings.timeout / cycle) - 2):
                clock.now += cycle
                seen.append(source.sample(0.0, HERE)[0])
            near = away <= settings.start_tolerance
            assert seen[-1] == pytest.approx(away if near else 0.0)
            assert np.diff(seen).max() <= 1.1 * away / MAX_INTERVAL * cycle
            if not near:
                assert b"expected at most 0.02 (setpoints.start_tolerance)" in answer(two)
                source.discard()  # the motion is over
                for q in (away, -away):
                    with planner(source) as next_one:
                        next_one.sendall(f"{q},0,0\n".encode())
                        assert source.first(HERE) == pytest.approx([q, 0.0, 0.0])
                    source.listen()


def test_the_socket_of_a_loop_that_was_killed_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "p.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    settings = SetpointSettings(source="planner", socket=path)
    source = PlannerSource(SourceContext(settings, 3, True, Path(), RATE, SYSTEM))
    source.open()
    with planner(source) as link:
        link.sendall(GOOD)
        assert first_of(source) is not None
    source.close()


def test_the_socket_of_a_running_loop_is_not_replaced(feed: PlannerSource) -> None:
    """Else the planner of one arm would move another, as with two cells and one ``socket``."""
    second = PlannerSource(SourceContext(feed.settings, 3, True, Path(), RATE, SYSTEM))
    with pytest.raises(RunError, match="another process listens there"):
        second.open()
    second.close()
    with planner(feed) as link:
        link.sendall(GOOD)
        assert first_of(feed) is not None


def test_another_users_process_is_refused(
    feed: PlannerSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    stranger = Peer(1, os.geteuid() + 1)
    monkeypatch.setattr("gapbridge.bridge.setpoint_source.planner.peer_of", lambda _: stranger)
    with planner(feed) as link:
        link.sendall(GOOD)
        reply, setpoint_came = closed_by(feed, link)
        assert b"another user" in reply
        assert not setpoint_came


@pytest.mark.parametrize(
    "line", ["", GOOD.decode(), "token", "token ", f"token {TOKEN[:-1]}", f"token {TOKEN}0",
             TOKEN, f"Token {TOKEN}", f"POST / HTTP/1.1\r\nx: token {TOKEN}"],
)  # fmt: skip
def test_over_tcp_nothing_counts_before_the_token(line: str, tcp: TcpSource) -> None:
    with planner(tcp) as link:
        link.sendall(line.encode() + b"\n" + GOOD)
        reply, setpoint_came = closed_by(tcp, link)
        assert not setpoint_came
        assert b"expected the token in the first line" in reply
        assert TOKEN.encode() not in reply


def test_over_tcp_the_token_opens_the_feed(tcp: TcpSource) -> None:
    with planner(tcp) as link:
        link.sendall(f"token {TOKEN}\r\n".encode() + GOOD)
        assert first_of(tcp) == pytest.approx(np.zeros(3))


def test_over_tcp_a_token_that_does_not_come_ends_the_connection(
    tcp: TcpSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gapbridge.bridge.setpoint_source.tcp.FIRST_LINE", 0.1)
    with planner(tcp) as link:
        assert b"no token within" in closed_by(tcp, link)[0]


def test_a_taken_address_is_one_line(tcp: TcpSource, tmp_path: Path) -> None:
    settings = tcp.settings.model_copy(update={"port": tcp.port})
    with pytest.raises(RunError, match="cannot listen on"):
        TcpSource(SourceContext(settings, 3, True, Path(), RATE, SYSTEM)).open()
    settings = SetpointSettings(source="planner", socket=tmp_path / "no" / "p.sock")
    with pytest.raises(RunError, match="cannot listen on"):
        PlannerSource(SourceContext(settings, 3, True, Path(), RATE, SYSTEM)).open()


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "127.0.0.1.evil.example", "127.evil.example", "127.1", "robot", "::", ""]
)
def test_a_feed_that_others_could_reach_is_refused(host: str) -> None:
    with pytest.raises(ValueError, match="loopback"):
        SetpointSettings(source="modbus", host=host)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.8.7", "::1", "localhost"])
def test_a_loopback_address_is_taken(host: str) -> None:
    assert SetpointSettings(source="modbus", host=host).host == host


def test_a_cell_with_a_port_and_no_token_is_refused_and_names_what_to_set(tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(
        "robot: {model: ur10e}\nlink: {host: 127.0.0.1}\nsetpoints: {source: tcp, port: 30310}\n"
    )
    with pytest.raises(CellError, match=r"token_file.*source: planner") as refusal:
        load_cell(path)
    assert str(refusal.value).startswith(f"{path}, line 3: ")
    assert "\n" not in str(refusal.value)
    token = tmp_path / "token"
    path.write_text(path.read_text().replace("port: 30310", "token_file: token"))
    with pytest.raises(CellError, match=r"setpoints\.token_file: .*expected a file with a token"):
        settings_of(load_cell(path))
    token.write_text(TOKEN)
    token.chmod(0o644)
    with pytest.raises(CellError, match="found mode 0644, expected 0600"):
        settings_of(load_cell(path))
    token.chmod(0o600)
    assert settings_of(load_cell(path)).setpoints.token_file == token


def test_a_planners_socket_is_in_the_runtime_folder_unless_the_cell_names_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    path = tmp_path / "cell.yaml"
    text = "robot: {model: ur10e}\nlink: {host: 127.0.0.1}\nsetpoints: {source: planner}\n"
    path.write_text(text)
    found = settings_of(load_cell(path)).setpoints.socket
    assert found is not None
    assert found.parent == tmp_path / "gapbridge"
    assert stat.S_IMODE(found.parent.stat().st_mode) == 0o700
    path.write_text(text.replace("planner}", "planner, socket: here.sock}"))
    assert settings_of(load_cell(path)).setpoints.socket == tmp_path / "here.sock"


@pytest.mark.parametrize(
    ("name", "found"),
    [("folder", "found a folder"), ("cell.yaml", "found a file"), ("no/s", "found no folder "),
     ("s" * 108, "bytes, expected a path for a Unix socket, of at most 107 bytes")],
)  # fmt: skip
def test_a_path_that_no_socket_can_have_is_found_before_a_run(
    name: str, found: str, tmp_path: Path
) -> None:
    (tmp_path / "folder").mkdir()
    path = tmp_path / "cell.yaml"
    path.write_text(
        "robot: {model: ur10e}\nlink: {host: 127.0.0.1}\n"
        f"setpoints: {{source: planner, socket: {name}}}\n"
    )
    with pytest.raises(CellError, match=rf"line 3: .*{found}"):
        settings_of(load_cell(path))


def test_what_came_while_nobody_read_is_no_setpoint(feed: PlannerSource) -> None:
    """Arming takes a while: lines of that time are of unknown age, and not counted either."""
    with planner(feed) as link:
        link.sendall(b"0,0,0.1\n")
        assert first_of(feed) == pytest.approx([0, 0, 0.1])
        link.sendall(b"".join(b"0,0,%.4f\n" % (1e-4 * k) for k in range(3 * int(RATE))))
        feed.discard()
        assert feed.first(HERE) is None
        link.sendall(b"0,0,0.7\n")
        assert first_of(feed) == pytest.approx([0, 0, 0.7])


def test_a_planner_that_died_before_arming_starts_nothing(feed: PlannerSource) -> None:
    with planner(feed) as link:
        link.sendall(60 * b"0,0,0.1\n")
    feed.discard()
    assert feed.first(HERE) is None


def test_a_token_sent_while_nobody_read_still_counts(tcp: TcpSource) -> None:
    with planner(tcp) as link:
        link.sendall(b"token " + TOKEN.encode() + b"\n0,0,0.1\n0,0,0.2\n")
        tcp.discard()
        assert tcp.first(HERE) is None
        link.sendall(b"0,0,0.7\n")
        assert first_of(tcp) == pytest.approx([0, 0, 0.7])
