"""The page about the daemon says what the table of states says, and names every counter."""

from __future__ import annotations

from pathlib import Path

import pytest

from gapbridge.bridge.ipc.loop_counters import LoopCounter
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.loop.supervisor import TRANSITIONS, states_table

PAGE = (Path(__file__).parents[3] / "docs" / "daemon.md").read_text(encoding="utf-8")
ELSEWHERE = {LoopCounter.SILENCE, LoopCounter.LINK_LOST}  # what stale comes to, reported in its row


def test_the_page_has_the_table_as_it_is() -> None:
    assert states_table() in PAGE
    assert states_table().count("| observing |") >= 1
    filled = sum(
        len([cell for cell in line.split("|")[2:-1] if cell.strip()])
        for line in states_table().splitlines()[2:]
    )
    assert filled == len(TRANSITIONS)


@pytest.mark.parametrize("count", sorted(set(LoopCounter) - ELSEWHERE))
def test_the_page_explains_every_counter(count: LoopCounter) -> None:
    assert f"`{count.label}`" in PAGE


@pytest.mark.parametrize("state", State)
def test_the_page_explains_every_state(state: State) -> None:
    assert f"\n| {state.name.lower()} | " in PAGE
