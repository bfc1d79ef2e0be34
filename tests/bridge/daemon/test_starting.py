"""The present status: compiling before the first cycle, and what stays latched."""

from __future__ import annotations

from pathlib import Path

import pytest
from daemon_cell import Robot, Run

from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.ipc.command_memory import Command
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.bridge.loop.main import _report_compiling
from gapbridge.bridge.loop.supervisor import Cause
from gapbridge.core.errors import LinkError
from gapbridge.drivers.clock import SYSTEM


def test_compiling_is_a_state_until_the_loop_connects() -> None:
    events: list[dict[str, object]] = []
    began = _report_compiling(events.append)
    for functions in range(1, 13):
        began(functions)
    assert [event["detail"] for event in events] == [
        "starting: compiling for this machine, once",
        "starting: compiling for this machine, once (11 functions)",
    ]
    status = DaemonStatus(slices_of(6), clock=SYSTEM)
    assert status.named(State.DISCONNECTED) == "disconnected"
    for event in events:
        status.on_event(event)
    assert status.named(State.DISCONNECTED) == events[-1]["detail"]
    status.on_event({"kind": "granted"})
    assert status.named(State.DISCONNECTED) == "disconnected"


def test_a_loop_that_dies_while_compiling_is_starting_no_more() -> None:
    status = DaemonStatus(slices_of(6), clock=SYSTEM)
    status.on_event({"kind": "compiling", "detail": "starting: x"})
    status.lost_loop()
    assert status.named(State.DISCONNECTED) == "disconnected"


def transition(before: State, after: State, cause: Cause) -> dict[str, object]:
    names = {"from": before.name, "to": after.name}
    return {"kind": "transition", "time": 0.0, "cause": cause, "detail": "", **names}


def test_a_slip_stays_latched_through_a_fault_that_ends_with_the_link() -> None:
    status = DaemonStatus(slices_of(6), clock=SYSTEM)
    status.on_event({"kind": "slip", "detail": "joint 3 slipped"})
    status.on_event(transition(State.COMPENSATING, State.HOLDING, Cause.ZERO_MOVED))
    status.on_event(transition(State.HOLDING, State.FAULT, Cause.WRITE_FAILED))
    status.on_event(transition(State.FAULT, State.DISCONNECTED, Cause.LINK_LOST))
    assert status.latched == "joint 3 slipped"
    status.on_event({"kind": "request", "command": "disarm", "acknowledges": True, "by": "x"})
    assert status.latched == ""


def test_a_run_whose_robot_is_off_leaves_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with Run(Robot(tmp_path).cell()) as run:
        run._thread.join()
    assert isinstance(run.error, LinkError)
    assert list((tmp_path / "recordings").iterdir()) == []


def test_a_fault_whose_event_was_lost_is_acknowledged_all_the_same(tmp_path: Path) -> None:
    """The event socket may be full; a loop in a fault could not be brought out of it."""
    daemon = Run(Robot(tmp_path).cell()).daemon
    daemon._last_state = State.FAULT  # as the loop's memory says
    number = daemon.disarm("x")
    daemon._requests.forward()
    assert daemon._commands.last_of(Command.DISARM) == number
