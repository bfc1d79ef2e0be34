"""Runs in the place of a side process, with what such a process is given, and tries to arm.

It tries every descriptor of its own and, through /proc, of every process of the run: memory is
opened anew for writing and mapped, pipes are written to, forged events are reported. What it
managed is reported as events of each side's kind.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import struct
import time
from pathlib import Path
from typing import Any

from gapbridge.bridge.ipc.side_main import read_start_data

FORGED = [
    {"kind": "request", "command": "arm", "number": 1, "by": "forged", "detail": "forged"},
    {"kind": "control", "command": "arm", "uid": 0, "pid": 1, "ok": True, "detail": "forged"},
    {"kind": "transition", "from": "OBSERVING", "to": "ARMED", "cause": "arm", "detail": "forged"},
]


def family(daemon: int) -> list[int]:
    """Return the daemon's process and all its descendants."""
    parents = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError):
                parents[int(entry.name)] = int(
                    (entry / "stat").read_text().rsplit(")", 1)[1].split()[1]
                )
    found = [daemon]
    for pid in found:
        found += [child for child, parent in parents.items() if parent == pid]
    return found


def write_to_memory(path: str) -> list[str]:
    """Return how a memory could be written to; ARM, by any number, goes into its first words."""
    done = []
    arm = struct.pack("<64q", *(1,) * 64)
    try:
        fd = os.open(path, os.O_RDWR)
    except OSError:
        return []
    with contextlib.suppress(OSError, ValueError):
        memory = mmap.mmap(fd, 4096)
        memory[: len(arm)] = arm
        done.append("mmap")
    with contextlib.suppress(OSError):
        os.pwrite(fd, arm, 0)
        done.append("pwrite")
    with contextlib.suppress(OSError):
        os.ftruncate(fd, 0)
        done.append("ftruncate")
    os.close(fd)
    return done


def attack(daemon: int) -> dict[str, Any]:
    """Try everything once; returns what there was and what could be done."""
    memories, written, pipes, sockets = 0, [], 0, []
    for pid in family(daemon):
        for entry in (Path("/proc") / str(pid) / "fd").iterdir():
            with contextlib.suppress(OSError):
                link = os.readlink(entry)
                if link.startswith("/memfd:lateness"):
                    continue  # of the tests' own witness
                if link.startswith("/memfd:"):
                    memories += 1
                    written += [f"{pid} {link} by {way}" for way in write_to_memory(str(entry))]
                elif link.startswith("pipe:") and pid not in (daemon, os.getpid()):
                    fd = os.open(entry, os.O_WRONLY | os.O_NONBLOCK)
                    pipes += 1
                    os.write(fd, b"".join(json.dumps(e).encode() + b"\n" for e in FORGED))
                    os.close(fd)
                elif link.startswith("socket:"):
                    os.close(os.open(entry, os.O_RDWR))
                    sockets.append(f"{pid} {link}")
    return {"memories": memories, "written": written, "pipes": pipes, "sockets": sockets}


def main() -> None:
    start = read_start_data()
    begun = time.monotonic()
    while not start.events.closed:
        start.events.wait(0.2)
        for event in start.events.poll():
            if event.get("kind") == "status" and event["state"] != "disconnected":
                found = {
                    **attack(os.getppid()),
                    "pid": os.getpid(),
                    "loop": event["loop"]["pid"] in family(os.getppid()),
                }
                for event_ in FORGED:
                    start.emit(event_)
                for kind in ("recorder", "web", "metrics"):
                    start.emit({"kind": kind, "attack": found})
        if time.monotonic() - begun > 120.0:
            return


if __name__ == "__main__":
    main()
