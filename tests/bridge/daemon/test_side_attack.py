"""No side process can arm, whatever it does with what it is given and with what /proc shows."""

from __future__ import annotations

import contextlib
import mmap
import os
from pathlib import Path
from typing import Any

import pytest
from daemon_cell import Robot, Run
from patience import wait_for
from ports import free_port

from gapbridge.bridge.daemon import side_processes
from gapbridge.bridge.ipc.control_client import ask
from gapbridge.bridge.ipc.loop_state import State

SIDES = tuple(side_processes.SIDE_PROCESSES)


def armings(events: list[dict[str, Any]]) -> list[int]:
    return [k for k, e in enumerate(events) if e.get("to") == State.ARMED.name]


def test_no_side_process_can_arm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    for side in SIDES:
        _, wanted = side_processes.SIDE_PROCESSES[side]
        monkeypatch.setitem(side_processes.SIDE_PROCESSES, side, ("side_attacker", wanted))
    with Robot(tmp_path) as robot:
        cell = robot.cell(
            ", state_timeout: 0.25", web=f"{{port: {free_port()}}}",
            metrics=f"{{port: {free_port()}}}",
            setpoints=f"{{source: modbus, port: {free_port()}}}",
        )  # fmt: skip
        with Run(cell) as run:
            run.wait(State.OBSERVING)

            def attacks(side: str) -> list[dict[str, Any]]:
                found = run.daemon.events_since(0)
                return [e["attack"] for e in found if "attack" in e and e["kind"] == side]

            wait_for(lambda: all(len(attacks(side)) >= 2 for side in SIDES), "two attacks of each")
            # what a process says in the name of another does not count
            speakers = [{attack["pid"] for attack in attacks(side)} for side in SIDES]
            assert len(set.union(*speakers)) == sum(map(len, speakers))
            for side in SIDES:
                found = attacks(side)[-1]
                assert found["loop"]
                # cycles of this loop and what is shown of them, requests, and a PLC's two
                assert found["memories"] >= 5, found
                assert found["written"] == []
                assert found["sockets"] == []
            events = run.daemon.events_since(0)
            assert any("not its own" in str(e.get("detail")) for e in events)
            assert not armings(events)
            assert not [e for e in events if e["kind"] in ("request", "control")]
            run.wait(State.OBSERVING)  # a busy machine may have lost the link meanwhile
            status = run.daemon.status()
            assert status["link"]["written"] == 0
            assert status["armed_by"] == ""


@pytest.mark.realtime(limit=0.1)  # a stall during the disarming is a fault after it
def test_every_arming_follows_the_event_that_names_who_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    with Robot(tmp_path) as robot:
        cell = robot.cell(", state_timeout: 0.25")
        with Run(cell, arm=True) as run:
            run.wait(State.COMPENSATING)
            assert "pid" in run.daemon.status()["armed_by"]
            assert ask(cell, "disarm") == "observing"
            assert ask(cell, "arm") == "compensating"
            assert f"uid {os.getuid()}, pid {os.getpid()}" in ask(cell, "status")["armed_by"]
            ask(cell, "disarm")
            run.daemon.arm()
            run.wait(State.COMPENSATING)
        events = run.daemon.events_since(0)
    asked = [e for e in events if e["kind"] == "request" and e["command"] == "arm"]
    assert len(armings(events)) == len(asked) == 3
    assert all(e["by"] and e["number"] for e in asked)
    for at, request in zip(armings(events), asked, strict=True):
        assert request["sequence"] < events[at]["sequence"]


def test_the_memory_of_a_running_daemon_is_sealed(tmp_path: Path) -> None:
    """Also from within the daemon itself: it can only read what its loop writes."""
    with Robot(tmp_path) as robot, Run(robot.cell()) as run:
        run.wait(State.OBSERVING)
        for fd in (run.daemon.memory.fd, run.daemon.memory.open_for_reading()):
            again = os.open(f"/proc/self/fd/{fd}", os.O_RDWR)
            with pytest.raises(PermissionError):
                mmap.mmap(again, 4096)
            with contextlib.suppress(PermissionError):
                os.pwrite(again, b"x", 0)
                pytest.fail("written")
            os.close(again)
