"""Whom a person's command speaks to: only the daemon of this user, whatever others put there."""

from __future__ import annotations

import os
import socket
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from patience import PATIENCE

from gapbridge.bridge.cell import runtime_folder as runtime_module
from gapbridge.bridge.cell.runtime_folder import candidates, cell_key, runtime_folder
from gapbridge.bridge.ipc import control_client
from gapbridge.bridge.ipc.control_client import ask, ask_socket, running
from gapbridge.bridge.ipc.control_socket import ControlSocket, Peer
from gapbridge.core.errors import InputError, RunError
from gapbridge.drivers.clock import SYSTEM

STRANGER = 23456  # a user


@pytest.fixture
def cell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a cell that nobody runs, with a runtime folder for it alone."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    found = tmp_path / "cell.yaml"
    found.write_text("robot: {model: ur10e}\n")
    return found


@pytest.fixture
def short_folder() -> Iterator[Path]:
    """Return a folder that can hold a user's, and that a socket: a path of at most 107 bytes."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture
def asked(cell: Path) -> Iterator[list[str]]:
    """Serve the cell's socket, saying that all is well; yields what was asked for."""
    heard: list[str] = []

    def answer(command: str, _: Peer) -> dict[str, object]:
        heard.append(command)
        return {"ok": True, "answer": "observing"}

    with ControlSocket(runtime_folder() / f"{cell_key(cell)}.sock", answer, SYSTEM):
        yield heard


def test_a_daemon_is_found_by_a_link_to_its_cell_and_without_the_file(
    cell: Path, asked: list[str]
) -> None:
    """It was started by the link, or its file was moved: nobody could disarm the arm."""
    link = cell.with_name("current.yaml")
    link.symlink_to(cell.name)
    assert ask(link, "disarm") == "observing"
    cell.rename(cell.with_name("moved.yaml"))
    assert ask(cell, "disarm") == "observing"
    assert ask(link, "disarm") == "observing"


@pytest.mark.parametrize("user", ["own", "another"])
def test_a_daemon_of_a_login_is_found_without_its_environment(
    cell: Path, short_folder: Path, monkeypatch: pytest.MonkeyPatch, user: str
) -> None:
    """By su, sudo and cron: they said that no daemon runs. Root finds everybody's."""
    if user == "another" and os.geteuid() != 0:
        pytest.skip("only root may ask daemons of others")
    number = os.geteuid() if user == "own" else STRANGER
    (folder := short_folder / str(number)).mkdir(0o700)
    monkeypatch.setattr(runtime_module, "LOGINS", short_folder)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(folder))
    path = runtime_folder() / f"{cell_key(cell)}.sock"
    with ControlSocket(path, lambda command, _: {"ok": True, "answer": command}, SYSTEM):
        os.chown(path.parent, number, -1)
        monkeypatch.delenv("XDG_RUNTIME_DIR")
        assert ask(cell, "disarm") == "disarm"


def test_who_asks_for_no_daemon_is_told_which_ones_run(
    cell: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link was set to another cell while the daemon of the one before runs."""
    monkeypatch.setattr(control_client, "running", list)  # other tests have daemons
    with pytest.raises(InputError, match=r"expected one: gapbridge run$"):
        ask(cell, "disarm")
    monkeypatch.setattr(control_client, "running", lambda: [{"cell": "/cells/before.yaml"}])
    with pytest.raises(InputError, match=r"no running daemon.* \(running: /cells/before.yaml\)"):
        ask(cell, "disarm")


def test_a_socket_in_a_folder_of_somebody_else_is_not_believed(
    cell: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ask(cell, "disarm") == "observing"
    user = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: user)
    with pytest.raises(InputError, match="another user"):
        ask(cell, "disarm")
    assert asked == ["disarm"]


def test_a_socket_of_somebody_else_is_not_believed(
    cell: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control_client, "peer_of", lambda _: Peer(1, STRANGER))
    with pytest.raises(InputError, match="another user"):
        ask(cell, "disarm")
    assert asked == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may ask daemons of others")
def test_root_asks_a_service_user_but_nobody_where_everybody_makes_folders(
    cell: Path, asked: list[str]
) -> None:
    folder = candidates()[0]
    os.chown(folder, STRANGER, STRANGER)
    assert ask(cell, "disarm") == "observing"  # as in /run/gapbridge
    folder.parent.chmod(0o1777)  # as in /tmp
    with pytest.raises(InputError, match="another user"):
        ask(cell, "disarm")
    assert asked == ["disarm"]


@pytest.mark.parametrize("reply", [b"[]", b"3", b"", b"observing", b"[" * 100_000])
def test_an_answer_that_is_none_is_one_line(cell: Path, reply: bytes) -> None:
    path = runtime_folder() / "x.sock"
    with socket.socket(socket.AF_UNIX) as listener, ThreadPoolExecutor(1) as pool:
        listener.bind(str(path))
        listener.listen()
        asked = pool.submit(ask_socket, path, "disarm")
        with listener.accept()[0] as connection:
            connection.recv(100)
            connection.sendall(reply + b"\n")
        with pytest.raises(RunError, match="without an answer"):
            asked.result(PATIENCE)


def test_the_status_of_all_daemons_is_not_asked_of_a_planners_socket(
    cell: Path, asked: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = runtime_folder()
    monkeypatch.setattr(control_client, "candidates", lambda: [folder])  # not of other tests
    path = folder / "x.planner.sock"
    with socket.socket(socket.AF_UNIX) as planner:
        planner.bind(str(path))
        planner.listen()
        planner.setblocking(False)
        assert running() == ["observing"]
        with pytest.raises(BlockingIOError):
            planner.accept()  # while the loop connects or arms, nobody would answer
