"""The table of states: only a person's arming leads to writing, and every fault leads out of it."""

from __future__ import annotations

from itertools import pairwise, product

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.supervisor import (
    CLEARED_BY_RECONNECTING,
    RAMPS_OUT,
    STOPS_AT_ONCE,
    TRANSITIONS,
    Cause,
    Supervisor,
)

BAD = set(RAMPS_OUT) | set(STOPS_AT_ONCE) | {Cause.LINK_LOST}
PERSON = {Cause.ARM, Cause.ACKNOWLEDGED}
SERIOUSNESS = {
    State.COMPENSATING: 3, State.HOLDING: 2, State.ARMED: 1, State.OBSERVING: 0, State.FAULT: -1,
    State.DISCONNECTED: -2,
}  # fmt: skip
"""How much a state lets out; no fault may lead to more."""


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
    for state, cause in product((State.COMPENSATING, State.HOLDING), STOPS_AT_ONCE):
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
def test_every_change_is_reported_and_nothing_else(causes: list[Cause]) -> None:
    events: list[tuple[State, State]] = []
    machine = Supervisor(lambda before, after, *_: events.append((before, after)))
    changed = [machine.state for cause in causes if machine.take(cause)]
    assert events == list(pairwise([State.DISCONNECTED, *changed]))


def test_every_state_can_be_left_when_the_link_is_lost() -> None:
    for state in State:
        machine = supervisor(state)
        machine.take(Cause.LINK_LOST)
        assert machine.state == State.DISCONNECTED


@pytest.mark.parametrize(("state", "cause"), list(product(State, Cause)))
def test_every_pair_of_state_and_cause_keeps_the_rules(state: State, cause: Cause) -> None:
    machine = supervisor(state)
    changed = machine.take(cause)
    after = machine.state
    assert changed == ((state, cause) in TRANSITIONS)
    assert changed or after == state
    if (state, cause) != (State.FAULT, Cause.UNSAFE):  # which becomes the fault that is latched
        assert after != state or not changed  # a transition leads somewhere else
    if after.writes and not state.writes:
        assert (state, cause) == (State.ARMED, Cause.WRITING)
    if after == State.COMPENSATING:
        assert state in (State.ARMED, State.COMPENSATING)
    if state == State.FAULT and changed:
        assert (cause, after) in {
            (Cause.ACKNOWLEDGED, State.OBSERVING), (Cause.LINK_LOST, State.DISCONNECTED),
            (Cause.UNSAFE, State.FAULT),
        }  # fmt: skip
    if state == State.DISCONNECTED and changed:
        assert (cause, after) == (Cause.CONNECTED, State.OBSERVING)
    if cause in BAD:
        assert SERIOUSNESS[after] <= SERIOUSNESS[state]
        if state == State.COMPENSATING:
            assert after != State.COMPENSATING
    if cause in STOPS_AT_ONCE and state in (State.ARMED, State.COMPENSATING, State.HOLDING):
        assert after == State.FAULT


@pytest.mark.parametrize(
    "cause", [Cause.SILENCE, Cause.UNSAFE, Cause.WRITE_FAILED, Cause.BAD_OUTPUT]
)
def test_what_no_ramp_can_follow_is_a_fault_at_once(cause: Cause) -> None:
    for state in (State.ARMED, State.COMPENSATING, State.HOLDING):
        assert TRANSITIONS[state, cause] == State.FAULT


def reached(start: State, causes: set[Cause]) -> set[State]:
    found, waiting = {start}, [start]
    while waiting:
        state = waiting.pop()
        for cause in causes:
            after = TRANSITIONS.get((state, cause), state)
            if after not in found:
                found.add(after)
                waiting.append(after)
    return found


def test_every_state_is_reached_and_each_can_come_to_fault_and_to_disconnected() -> None:
    everything = set(Cause)
    assert reached(State.DISCONNECTED, everything) == set(State)
    for state in State:
        assert {State.FAULT, State.DISCONNECTED, State.OBSERVING} <= reached(state, everything)


def test_without_a_person_a_fault_stays_unless_its_link_goes() -> None:
    assert reached(State.FAULT, set(Cause) - PERSON - {Cause.LINK_LOST}) == {State.FAULT}
    assert reached(State.FAULT, set(Cause) - {Cause.ARM}) == {
        State.FAULT, State.OBSERVING, State.DISCONNECTED
    }  # fmt: skip


def test_every_way_into_writing_passes_a_persons_arming() -> None:
    for state in set(State) - {State.ARMED, State.COMPENSATING, State.HOLDING}:
        assert not any(s.writes for s in reached(state, set(Cause) - {Cause.ARM}))


def test_only_faults_of_the_link_end_with_it() -> None:
    robots_own = {Cause.UNSAFE, Cause.BAD_OUTPUT, Cause.FOREIGN, Cause.SETPOINT_REFUSED}
    assert not robots_own & set(CLEARED_BY_RECONNECTING)
    to_fault = {cause for (_, cause), after in TRANSITIONS.items() if after == State.FAULT}
    assert set(CLEARED_BY_RECONNECTING) <= to_fault
