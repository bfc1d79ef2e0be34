"""The local socket: who may open it, what it answers, and what it never does."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import stat
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, cast

import pytest
from clock_by_hand import ByHand
from daemon_cell import Robot, Run, ask_again, gapbridge
from patience import PATIENCE, wait_for
from simulated_daemon import ask as ask_in_simulation
from simulated_daemon import causes, rides_on_a_program, until

from gapbridge.bridge.cell.runtime_folder import cell_key, runtime_folder
from gapbridge.bridge.cell.verification_mark import write_mark
from gapbridge.bridge.daemon import control
from gapbridge.bridge.ipc import control_client, control_socket
from gapbridge.bridge.ipc.control_client import ask, ask_socket, running
from gapbridge.bridge.ipc.control_socket import ControlSocket, Peer
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import Phase
from gapbridge.bridge.loop.loop import DAEMON_SILENT
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import SYSTEM

PATIENT = ", state_timeout: 0.25"  # a busy machine holds the simulated controller up


@pytest.fixture(autouse=True)
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    return tmp_path / "gapbridge"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Path, list[tuple[str, Peer]]]]:
    asked: list[tuple[str, Peer]] = []

    def answer(command: str, peer: Peer) -> dict[str, Any]:
        asked.append((command, peer))
        return {"ok": True, "answer": command}

    path = tmp_path / "x.sock"
    with ControlSocket(path, answer, SYSTEM):
        yield path, asked


def talk(path: Path, data: bytes) -> dict[str, Any]:
    with socket.socket(socket.AF_UNIX) as link:
        link.settimeout(10)
        link.connect(str(path))
        link.sendall(data)
        link.shutdown(socket.SHUT_WR)
        found: dict[str, Any] = json.loads(link.makefile().readline())
        return found


def test_a_command_is_answered_and_its_sender_known(
    served: tuple[Path, list[tuple[str, Peer]]],
) -> None:
    path, asked = served
    assert ask_socket(path, "status") == "status"
    assert asked == [("status", Peer(os.getpid(), os.getuid()))]


def test_only_its_owner_can_open_it(served: tuple[Path, list[Any]], runtime: Path) -> None:
    path, _ = served
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(runtime_folder().stat().st_mode) == 0o700
    assert runtime_folder() == runtime


def test_another_user_is_refused_though_the_socket_were_open(
    served: tuple[Path, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, asked = served
    monkeypatch.setattr(control_socket, "peer_of", lambda _: Peer(1, os.geteuid() + 1))
    reply = talk(path, b'{"command": "arm"}\n')
    assert not reply["ok"]
    assert "found user" in reply["error"]
    assert asked == []


@pytest.mark.skipif(os.getuid() != 0, reason="only root can become somebody else")
def test_somebody_else_cannot_even_connect(served: tuple[Path, list[Any]]) -> None:
    path, asked = served
    code = f"""
import os, socket
os.setuid(65534)
try:
    socket.socket(socket.AF_UNIX).connect({str(path)!r})
except PermissionError:
    raise SystemExit(7)
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 7
    assert asked == []


@pytest.mark.parametrize(
    "data",
    [b"", b"\n", b"arm\n", b"[]\n", b"{}\n", b'{"command": 3}\n', b'{"command": "reboot"}\n',
     b"\xff\xfe\n", b"{" * 4000, b"x" * 100_000],
)  # fmt: skip
def test_nonsense_is_refused_in_one_line(served: tuple[Path, list[Any]], data: bytes) -> None:
    path, asked = served
    try:
        reply = talk(path, data)
    except (BrokenPipeError, ConnectionResetError, ValueError):
        reply = {"ok": False, "error": "expected"}  # it has hung up in the middle of too much
    assert not reply["ok"]
    assert "expected" in reply["error"]
    assert asked == []
    assert ask_socket(path, "status") == "status"


class OutOfDescriptors(socket.socket):
    """A listener whose first connections cannot be accepted."""

    left = 3

    def accept(self) -> tuple[socket.socket, Any]:
        if self.left:
            self.left -= 1
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
        return super().accept()


def test_a_connection_that_cannot_be_accepted_does_not_end_the_socket(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "x.sock"
    control = ControlSocket(path, lambda command, _: {"ok": True, "answer": command}, SYSTEM)
    with monkeypatch.context() as patched:
        patched.setattr(control_socket.socket, "socket", OutOfDescriptors)
        control.open()
    with contextlib.closing(control):
        assert ask_socket(path, "disarm") == "disarm"


def test_the_socket_of_a_killed_daemon_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "x.sock"
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    with ControlSocket(path, lambda command, _: {"ok": True, "answer": command}, SYSTEM):
        assert ask_socket(path, "disarm") == "disarm"


@pytest.mark.parametrize("busy", [False, True])
def test_the_socket_of_a_running_daemon_stays_its_own(tmp_path: Path, busy: bool) -> None:
    """Of the same cell file with another link: neither could be disarmed any more."""
    cell = tmp_path / "cell.yaml"
    path = runtime_folder() / f"{cell_key(cell)}.sock"
    second = control.Control(cast("Any", None), SYSTEM)
    with contextlib.ExitStack() as stack:
        if busy:  # it does not answer just now
            listener = stack.enter_context(socket.socket(socket.AF_UNIX))
            listener.bind(str(path))
            listener.listen(1)
            for _ in range(3):
                waiting = stack.enter_context(socket.socket(socket.AF_UNIX))
                waiting.setblocking(False)
                waiting.connect_ex(str(path))
        else:
            stack.enter_context(
                ControlSocket(path, lambda command, _: {"ok": True, "answer": command}, SYSTEM)
            )
        with pytest.raises(InputError, match="another daemon that runs this cell file"):
            stack.enter_context(second.socket(cell))
        assert path.exists()
        assert busy or ask_socket(path, "disarm") == "disarm"


def test_a_thread_that_cannot_be_started_does_not_end_the_socket(
    served: tuple[Path, list[Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    path, _ = served

    def fail(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", fail)
        for _ in range(2 * control_socket.MAX_UNREAD):
            with pytest.raises((RunError, OSError)):
                ask_socket(path, "status")
    assert ask_socket(path, "disarm") == "disarm"


@pytest.mark.parametrize("lists", [b"[" * 4000, b"[" * 900 + b"]" * 900, b"[" * 400 + b"]" * 400])
@pytest.mark.parametrize("start", [b"", b'{"command": '])
def test_what_is_nested_too_deep_is_refused(
    served: tuple[Path, list[Any]], start: bytes, lists: bytes
) -> None:
    path, asked = served
    reply = talk(path, (start + lists + b"}")[: control_socket.LONGEST_REQUEST - 1] + b"\n")
    assert "found no request" in reply["error"]
    assert asked == []


def test_connections_that_say_nothing_keep_no_request_out(
    served: tuple[Path, list[Any]],
) -> None:
    path, _ = served
    with contextlib.ExitStack() as stack:
        for _ in range(3 * control_socket.MAX_UNREAD):
            link = stack.enter_context(socket.socket(socket.AF_UNIX))
            link.connect(str(path))  # waits for a place among those to be accepted
        for command in ("status", "disarm"):
            assert ask_socket(path, command) == command


def test_requests_that_wait_for_their_answer_keep_no_disarm_out(tmp_path: Path) -> None:
    begun, go_on = threading.Semaphore(0), threading.Event()

    def answer(command: str, _: Peer) -> dict[str, Any]:
        if command == "arm":
            begun.release()
            assert go_on.wait(PATIENCE)
        return {"ok": True, "answer": command}

    path = tmp_path / "x.sock"
    with (
        ControlSocket(path, answer, SYSTEM),
        ThreadPoolExecutor(control_socket.MAX_REQUESTS) as pool,
    ):
        number = control_socket.MAX_REQUESTS
        armed = [pool.submit(talk, path, b'{"command": "arm"}\n') for _ in range(number)]
        try:
            assert all(begun.acquire(timeout=PATIENCE) for _ in range(number))
            with pytest.raises(RunError, match="not answered yet"):
                ask_socket(path, "status")
            assert ask_socket(path, "disarm") == "disarm"
        finally:
            go_on.set()
        assert all(each.result(PATIENCE)["ok"] for each in armed)
        assert ask_socket(path, "status") == "status"


def test_a_request_waits_for_a_place_among_the_connections(tmp_path: Path) -> None:
    path = tmp_path / "x.sock"
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as other:
        listener.bind(str(path))
        listener.listen(0)
        other.connect(str(path))
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(ask_socket, path, "disarm")
            with pytest.raises(TimeoutError):
                asked.result(0.2)  # there is no place yet
            with contextlib.ExitStack() as stack:
                stack.enter_context(listener.accept()[0])
                connection = stack.enter_context(listener.accept()[0])
                connection.recv(100)
                connection.sendall(b'{"ok": true, "answer": "observing"}\n')
                assert asked.result(PATIENCE) == "observing"


def test_a_daemon_that_does_not_answer_is_not_taken_for_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_client, "CONNECT_TRIES", 10)
    cell = tmp_path / "cell.yaml"
    cell.write_text("robot: {model: ur10e}\n")
    path = runtime_folder() / f"{cell_key(cell)}.sock"
    with socket.socket(socket.AF_UNIX) as listener, socket.socket(socket.AF_UNIX) as other:
        listener.bind(str(path))
        listener.listen(0)
        other.connect(str(path))  # and nobody accepts
        with pytest.raises(RunError, match="unavailable, expected an answer of the daemon"):
            ask(cell, "disarm")
    with pytest.raises(InputError, match="found no running daemon"):
        ask(cell, "disarm")  # its socket is left


def test_a_folder_of_somebody_else_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "gapbridge").symlink_to(tmp_path / "elsewhere")
    assert runtime_folder() != tmp_path / "gapbridge"


def test_a_cell_that_nobody_runs_is_one_line(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    with pytest.raises(InputError, match="file not found"):
        ask(cell, "status")
    cell.write_text("robot: {model: ur10e}\n")
    with pytest.raises(InputError, match="found no running daemon"):
        ask(cell, "status")


def test_a_person_arms_and_disarms_a_running_daemon(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)
        assert ask(cell, "disarm") == "is observing already"
        assert ask_again(cell, "arm") == "compensating"
        status = ask(cell, "status")
        assert status["state"] == "compensating"
        assert f"pid {os.getpid()}" in status["armed_by"]
        assert status["cell"] == str(cell)
        assert status["sides"]["recorder"]["pid"]
        assert status["session"] in [each["session"] for each in running()]
        assert ask(cell, "arm") == "is compensating already"
        assert ask(cell, "disarm") == "observing"
        assert ask(cell, "status")["armed_by"] == ""

        def granted() -> list[str]:
            events = [e for e in run.daemon.events_since(0) if e["kind"] == "control" and e["ok"]]
            assert {e["uid"] for e in events} == {os.getuid()}
            return [e["command"] for e in events]

        wait_for(lambda: granted()[-3:] == ["arm", "arm", "disarm"], "the last request's event")
    assert granted()[0] == "disarm"
    assert not any(runtime_folder().glob("*.sock"))


def test_a_fault_waits_for_a_person_and_arming_is_refused_until_then() -> None:
    with rides_on_a_program() as (run, world):
        run.link.controller.protective_stop()
        until(world, lambda: run.daemon.state == State.FAULT)
        refused = ask_in_simulation(run, "arm")["error"]
        assert "a fault is latched: robot not ready" in refused
        assert "safety_mode 3" in refused
        assert "as soon as the robot is fine" in ask_in_simulation(run, "disarm")["answer"]
        assert run.daemon.state == State.FAULT
        run.link.controller.unlock()
        until(world, lambda: run.daemon.state == State.OBSERVING)
        until(world, lambda: run.daemon.status()["latched"] == "")


def test_a_fault_after_a_request_to_disarm_is_named_at_once_and_not_acknowledged(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with rides_on_a_program() as (run, world):
        disarm = run.daemon.disarm

        def disarm_just_before_a_stop(by: str) -> int:
            number = disarm(by)
            run.link.controller.protective_stop()
            return number

        begun = world.now
        with monkeypatch.context() as patched:
            patched.setattr(run.daemon, "disarm", disarm_just_before_a_stop)
            refused = ask_in_simulation(run, "disarm")["error"]
        assert "a fault has occurred since: robot not ready" in refused
        assert "gapbridge disarm" in refused
        assert world.now - begun < 3.0
        assert run.daemon.latched
        run.link.controller.unlock()
        assert "acknowledged" in ask_in_simulation(run, "disarm")["answer"]
        until(world, lambda: run.daemon.state == State.OBSERVING)


@pytest.mark.slow
def test_a_latched_fault_outlives_the_loop_that_found_it(robot: Robot) -> None:
    with Run(robot.cell(PATIENT), arm=True) as run:
        run.compensate()
        robot.bench("protective_stop")
        run.wait(State.FAULT)
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, 9)
        run.wait(State.DISCONNECTED)
        run.wait(State.FAULT)
        assert "safety_mode 3" in run.daemon.latched
        robot.bench("unlock")
        run.daemon.disarm()
        run.wait(State.OBSERVING)


class Standing:
    """A daemon in one state, that notes what it is asked for."""

    state, phase, latched, may_write = State.OBSERVING, Phase.RUNNING, "", True
    sequence = last_taken = 0

    def __init__(self, **differs: Any) -> None:
        self.asked: list[str] = []
        self.noted: list[dict[str, Any]] = []
        for name, value in differs.items():
            setattr(self, name, value)

    def events_since(self, sequence: int) -> list[dict[str, Any]]:
        return [{"kind": "transition", "from": "ARMED", "to": "COMPENSATING"}]

    def arm(self, by: str) -> int:
        self.asked.append(by)
        return 1

    def note(self, event: dict[str, Any]) -> None:
        self.noted.append(event)


@pytest.mark.parametrize(
    ("differs", "words"),
    [({"may_write": False}, "only observes (--observe)"), ({"latched": "a stop"}, "a stop;"),
     ({"state": State.HOLDING}, "found state holding"), ({}, "")],
)  # fmt: skip
def test_only_a_daemon_that_may_write_observes_and_has_no_fault_is_armed(
    differs: dict[str, Any], words: str
) -> None:
    daemon: Any = Standing(**differs)
    reply = control.Control(daemon, clock=SYSTEM).answer("arm", Peer(4, 7))
    assert reply["ok"] == (not words)
    assert words in reply.get("error", "")
    assert daemon.asked == ([] if words else ["uid 7, pid 4"])
    assert daemon.noted[-1]["ok"] == reply["ok"]


class Silent(Standing):
    """One whose loop never answers."""

    def events_since(self, sequence: int) -> list[dict[str, Any]]:
        return []

    def disarm(self, by: str) -> int:
        self.asked.append(f"withdrawn: {by}")
        return 2


def test_an_arming_that_is_not_answered_is_withdrawn() -> None:
    clock, daemon = ByHand(), Silent()
    given: Any = daemon
    reply = control.Control(given, clock).answer("arm", Peer(4, 7))
    assert "no answer of the loop within 25 s" in reply["error"]
    assert daemon.asked == ["uid 7, pid 4", "withdrawn: uid 7, pid 4"]


@pytest.mark.slow
def test_a_daemon_that_only_observes_cannot_be_armed(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell, observe=True) as run:
        run.wait(State.OBSERVING)
        with pytest.raises(RunError, match="--observe"):
            ask(cell, "arm")


@pytest.mark.slow
def test_the_commands_show_in_a_line_and_as_json(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell) as run:
        run.wait(State.OBSERVING)

        def reported(*arguments: object) -> tuple[int, str, str]:
            done = gapbridge(*arguments, folder=robot.folder)
            out, err = done.communicate(timeout=PATIENCE)
            return done.returncode, out, err

        code, out, err = reported("status", cell)
        assert (code, err) == (0, "")
        assert f"{cell}: observing since" in out
        assert "Hz" in out
        assert json.loads(reported("status", cell, "--json")[1])["schema"] == "gapbridge.status/1"
        every = json.loads(reported("status", "--json")[1])
        assert str(cell) in [each["cell"] for each in every]
        assert reported("arm", cell) == (0, "compensating\n", "")
        assert reported("disarm", cell) == (0, "observing\n", ""), run.output
    code, out, err = reported("arm", cell)
    assert (code, out) == (2, "")
    assert err.startswith("error: ")
    assert err.count("\n") == 1


def test_the_same_cell_has_the_same_name_from_everywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cell_key(Path("cell.yaml")) == cell_key(tmp_path / "cell.yaml")
    assert cell_key(tmp_path / "cell.yaml") != cell_key(tmp_path / "a" / "cell.yaml")


@pytest.mark.parametrize(
    ("name", "stem"),
    [("cell_3", "cell_3"), (50 * "x", 40 * "x"), (40 * "я", 20 * "я"), (40 * "焊", 13 * "焊"),
     ("a\udcff", "a")],
)  # fmt: skip
def test_the_path_of_a_socket_is_short_enough_whatever_the_cells_name(
    tmp_path: Path, name: str, stem: str
) -> None:
    key = cell_key(tmp_path / f"{name}.yaml")
    assert len(f"/run/user/1000/gapbridge/{key}.planner.sock".encode()) <= 107  # unix(7)
    assert key[:-11] == stem


def test_a_folder_too_deep_for_a_socket_is_named_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deep = tmp_path / (120 * "x")
    deep.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(deep))
    served = control.Control(NoLoop(), clock=SYSTEM)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="path too long, expected a socket to listen on"):
        served.socket(tmp_path / "cell.yaml").__enter__()


@pytest.mark.slow
def test_a_disarming_between_two_loops_is_kept_and_answered_by_the_next(robot: Robot) -> None:
    cell = robot.cell(PATIENT)
    with Run(cell, arm=True) as run:
        run.compensate()
        robot.bench("protective_stop")
        run.wait(State.FAULT)
        robot.bench("unlock")
        pid = run.daemon.loop_pid
        assert pid is not None
        os.kill(pid, 9)
        run.wait(State.DISCONNECTED)
        assert run.daemon.latched
        taken = run.daemon.last_taken
        assert "acknowledged" in ask(cell, "disarm")  # by a person, while no loop is there
        assert run.daemon.last_taken > taken
        run.wait(State.OBSERVING)
        assert run.daemon.latched == ""


def test_a_cell_whose_verification_failed_does_not_arm_before_a_person_has_seen_it(
    robot: Robot,
) -> None:
    cell = robot.cell(PATIENT)
    mark = write_mark(cell, "the zero of joint 5 moved by 10 mrad", robot.folder)
    with Run(cell, arm=True) as run:
        run.wait(State.OBSERVING)
        wait_for(lambda: run.daemon.status()["counts"]["zero_moved"] == 1, "the count")
        assert any("acknowledge it first" in line for line in run.output)
        with pytest.raises(RunError, match="the zero of joint 5 moved by 10 mrad"):
            ask(cell, "arm")
        assert "observing" in ask(cell, "disarm")
        assert not mark.exists()
        assert "compensating" in ask_again(cell, "arm")


class NoLoop:
    """A daemon between two processes of the loop, of which no next one comes."""

    state, phase, latched, may_write, sequence = State.DISCONNECTED, Phase.STARTING, "x", True, 0
    last_taken, asked, mark_problem, armed_by = 3, 3, "", ""

    def disarm(self, by: str) -> int:
        self.asked += 1
        return self.asked

    def arm(self, by: str) -> int:
        return 0

    def note(self, event: dict[str, Any]) -> None:
        self.event = event


class Ending(NoLoop):
    """A daemon whose loop observes already, though its event has not come yet."""

    state, latched, last_taken, reads = State.OBSERVING, "", 1000, 0

    @property
    def armed_by(self) -> str:  # type: ignore[override]
        self.reads += 1
        return "somebody" if self.reads < 4 else ""


def test_a_disarming_is_answered_once_the_loops_own_event_has_come() -> None:
    daemon = Ending()
    assert control.Control(daemon, clock=SYSTEM).answer("disarm", Peer(1, 2))["ok"]  # type: ignore[arg-type]
    assert daemon.reads == 4


def test_a_disarming_that_no_loop_has_taken_is_not_called_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(control, "LONGEST_PICKUP", 0.1)
    daemon = NoLoop()
    reply = control.Control(daemon, clock=SYSTEM).answer("disarm", Peer(1, 2))  # type: ignore[arg-type]
    assert not reply["ok"]
    assert "no loop has taken it" in reply["error"]
    assert "kept for the next one" in reply["error"]
    assert daemon.asked == 4


def test_a_disarming_is_asked_for_though_the_arm_seems_to_observe() -> None:
    """A person's arming may be on its way: what is asked for after it stands."""
    daemon = NoLoop()
    daemon.state, daemon.latched, daemon.last_taken = State.OBSERVING, "", 9
    reply = control.Control(daemon, clock=SYSTEM).answer("disarm", Peer(1, 2))  # type: ignore[arg-type]
    assert reply == {"ok": True, "answer": "is observing already"}
    assert daemon.asked == 4


class GivesUp(NoLoop):
    """A daemon whose loop arms, then finds that what was before means nothing, and observes."""

    state, latched = State.OBSERVING, ""

    def arm(self, by: str) -> int:
        return 4

    def events_since(self, sequence: int) -> list[dict[str, Any]]:
        steps = [("OBSERVING", "ARMED", "arm", "arm"),
                 ("ARMED", "OBSERVING", "gap in time", "found a gap of 0.408 s")]  # fmt: skip
        return [
            {"kind": "transition", "from": a, "to": b, "cause": cause, "detail": detail}
            for a, b, cause, detail in steps
        ]


def test_an_arming_that_the_loop_gives_up_is_answered_at_once_and_says_why() -> None:
    reply = control.Control(GivesUp(), clock=SYSTEM).answer("arm", Peer(1, 2))  # type: ignore[arg-type]
    assert reply == {"ok": False, "error": "gap in time: found a gap of 0.408 s"}


@pytest.mark.parametrize("seconds", [0.6 * DAEMON_SILENT, 3.0 * DAEMON_SILENT])
def test_a_loop_whose_daemon_stands_still_ramps_out(seconds: float) -> None:
    """Stopped, as by a debugger: nobody could disarm. It goes on after a short while."""
    with rides_on_a_program() as (run, world):
        goes_on = world.now + seconds
        run.process.freeze(seconds)
        world.run(world.now + DAEMON_SILENT + 2.0, lambda: False)
        short = seconds < DAEMON_SILENT
        assert run.state() == (State.COMPENSATING if short else State.OBSERVING)
        until(world, lambda: world.now > goes_on + 1.0)
        assert ("daemon silent" in causes(run)) != short
        assert (run.daemon.state == State.COMPENSATING) == short  # and no daemon arms it again
        if not short:
            ask_in_simulation(run, "arm")
        assert run.daemon.state == State.COMPENSATING
