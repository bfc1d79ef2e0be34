"""Requests to running daemons over their local sockets."""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import time
from pathlib import Path
from typing import Any

from gapbridge.bridge.cell.runtime_folder import (
    PLANNER,
    candidates,
    cell_key,
    lookups,
    owner_of,
)
from gapbridge.bridge.ipc.control_socket import peer_of
from gapbridge.core.errors import InputError, RunError, first_line

ANSWER_TIMEOUT = 60.0  # s: a loop may have to restart, arming uploads a program to the robot
CONNECT_TRIES, RETRY = 1000, 0.01  # s between two: for a place among the daemon's connections


def ask(cell: Path, command: str) -> Any:
    """Return a daemon's answer to a command.

    Raises InputError if no daemon runs for the cell, RunError if it refuses or does not answer.
    The file need not be there any more: who moves it must still be able to disarm.
    """
    name = f"{cell_key(cell)}.sock"
    refused = silent = ""
    for folder in lookups():
        try:
            return ask_socket(folder / name, command)
        except PermissionError:
            refused = f"{folder / name}: found a daemon of another user, expected your own"
        except (FileNotFoundError, ConnectionRefusedError):
            continue  # no daemon has it open
        except OSError as error:
            silent = f"{folder / name}: {first_line(error)}, expected an answer of the daemon"
    if silent:
        raise RunError(silent)
    if not refused:
        others = ", ".join(str(status["cell"]) for status in running())
        if not (others or cell.exists()):
            raise InputError(f"{cell}: file not found, expected a cell file (YAML)")
        if not others:
            from gapbridge.bridge.cell.document import read_document  # brings yaml

            read_document(cell)  # raises for what is no cell
        refused = f"{cell}: found no running daemon, expected one: gapbridge run"
        refused += f" (running: {others})" if others else ""
    raise InputError(refused)


def ask_socket(path: Path, command: str) -> Any:
    """Return the answer from a daemon's socket.

    Raises PermissionError where another user has put folder or socket there: the names are known,
    and an answer such as "observing" must be the daemon's. Raises OSError, RunError.
    """
    owner = owner_of(path.parent)
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
        link.settimeout(ANSWER_TIMEOUT)
        _connect(link, path)
        if (uid := peer_of(link).uid) not in (0, owner):
            raise PermissionError(errno.EPERM, f"found a daemon of user {uid}", str(path))
        link.sendall(json.dumps({"command": command}).encode() + b"\n")
        with link.makefile("rb") as file:
            line = file.readline()
    try:
        reply = json.loads(line)
        if not isinstance(reply, dict):
            raise ValueError
    except (ValueError, RecursionError):
        raise RunError(f"{path}: the daemon ended without an answer") from None
    if not reply.get("ok"):
        raise RunError(str(reply.get("error", "refused")))
    return reply.get("answer")


def _connect(link: socket.socket, path: Path) -> None:
    """Connect as soon as there is a place. Raises OSError."""
    for _ in range(CONNECT_TRIES):
        with contextlib.suppress(BlockingIOError):  # at once where there is none (unix(7))
            return link.connect(str(path))
        time.sleep(RETRY)
    return link.connect(str(path))


def running() -> list[Any]:
    """Return the status of every daemon that answers."""
    statuses = []
    for folder in dict.fromkeys(candidates()):
        with contextlib.suppress(OSError):
            for path in sorted(folder.glob("*.sock")):
                if path.name.endswith(PLANNER):  # knows no status, and is read by cycles only
                    continue
                with contextlib.suppress(OSError, RunError):
                    statuses.append(ask_socket(path, "status"))
    return statuses
