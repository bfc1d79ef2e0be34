"""Before its first cycle a loop may compile: a state of its own, which ends with that."""

from __future__ import annotations

from gapbridge.bridge.daemon.status import DaemonStatus
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import slices_of
from gapbridge.bridge.loop.main import _report_compiling


def test_compiling_is_a_state_until_the_loop_connects() -> None:
    events: list[dict[str, object]] = []
    began = _report_compiling(events.append)
    for functions in range(1, 13):
        began(functions)
    assert [event["detail"] for event in events] == [
        "starting: compiling for this machine, once",
        "starting: compiling for this machine, once (11 functions)",
    ]
    status = DaemonStatus(slices_of(6))
    assert status.named(State.DISCONNECTED) == "disconnected"
    for event in events:
        status.on_event(event)
    assert status.named(State.DISCONNECTED) == events[-1]["detail"]
    status.on_event({"kind": "granted"})
    assert status.named(State.DISCONNECTED) == "disconnected"


def test_a_loop_that_dies_while_compiling_is_starting_no_more() -> None:
    status = DaemonStatus(slices_of(6))
    status.on_event({"kind": "compiling", "detail": "starting: x"})
    status.lost_loop()
    assert status.named(State.DISCONNECTED) == "disconnected"
