"""The table of states: only a person's arming leads to writing, and every fault leads out of it."""

from __future__ import annotations

from itertools import pairwise, product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.supervisor import TRANSITIONS, Cause, State, Supervisor

BAD = {
    Cause.SOURCE_DRY, Cause.SETPOINT_REFUSED, Cause.STALE, Cause.UNSAFE,
    Cause.WRITE_FAILED, Cause.LINK_LOST, Cause.DISARM, Cause.STOP,
}  # fmt: skip


def supervisor(state: State) -> Supervisor:
    found = Supervisor(lambda *_: None)
    found.state = state
    return found


def test_writing_begins_only_from_armed_and_arming_only_from_observing() -> None:
    to_writing = {key for key, after in TRANSITIONS.items() if after == State.COMPENSATING}
    to_armed = {key for key, after in TRANSITIONS.items() if after == State.ARMED}
    assert to_writing == {(State.ARMED, Cause.WRITING)}
    assert to_armed == {(State.OBSERVING, Cause.ARM)}


@pytest.mark.parametrize("cause", sorted(BAD))
def test_no_fault_is_survived_by_compensating(cause: Cause) -> None:
    machine = supervisor(State.COMPENSATING)
    machine.take(cause)
    assert machine.state in {State.HOLDING, State.FAULT, State.DISCONNECTED}


def test_a_broken_write_or_an_unsafe_robot_ends_writing_at_once() -> None:
    for state, cause in product(
        (State.COMPENSATING, State.HOLDING), (Cause.WRITE_FAILED, Cause.UNSAFE)
    ):
        machine = supervisor(state)
        assert machine.take(cause)
        assert not machine.state.writes


@given(st.lists(st.sampled_from([c for c in Cause if c != Cause.ARM])))
def test_without_a_person_nothing_is_ever_written(causes: list[Cause]) -> None:
    machine = supervisor(State.DISCONNECTED)
    for cause in causes:
        machine.take(cause)
        assert not machine.state.writes


@given(st.lists(st.sampled_from(list(Cause))))
def test_every_change_is_told_and_nothing_else(causes: list[Cause]) -> None:
    told: list[tuple[State, State]] = []
    machine = Supervisor(lambda before, after, *_: told.append((before, after)))
    changed = [machine.state for cause in causes if machine.take(cause)]
    assert told == list(pairwise([State.DISCONNECTED, *changed]))


def test_every_state_can_be_left_when_the_link_is_lost() -> None:
    for state in State:
        machine = supervisor(state)
        machine.take(Cause.LINK_LOST)
        assert machine.state == State.DISCONNECTED
