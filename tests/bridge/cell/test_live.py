"""Reading a controller with invalid samples, as ``check --live`` and ``init`` do."""

from __future__ import annotations

from typing import Any

import pytest

from gapbridge.bridge.cell import live
from gapbridge.core.errors import InvalidStateError, LinkError, StaleStateError
from gapbridge.drivers.clock import SYSTEM


class Bus:
    """Raises the given errors, then returns a state."""

    clock = SYSTEM

    def __init__(self, *errors: Exception) -> None:
        self.errors = list(errors)

    def read_state(self) -> Any:
        if self.errors:
            raise self.errors.pop(0)
        return "state"


def test_a_torn_and_a_late_sample_are_read_again() -> None:
    assert live.read_valid_state(Bus(InvalidStateError("torn"), StaleStateError("late"))) == "state"


def test_a_broken_link_is_not_waited_for() -> None:
    with pytest.raises(LinkError, match="cut"):
        live.read_valid_state(Bus(LinkError("cut")))


def test_a_bus_that_is_never_whole_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "READ_TIMEOUT", 0.0)
    with pytest.raises(InvalidStateError):
        live.read_valid_state(Bus(*[InvalidStateError("torn")] * 100_000))
