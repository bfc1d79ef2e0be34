"""Simulated sensors answer from a thread of the tests' own process, which may be a busy one."""

from __future__ import annotations

import pytest
from patience import PATIENCE

from gapbridge.drivers.ft_sensor import robotiq_ft300


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the start of a Robotiq's stream as many attempts, of a second each."""
    monkeypatch.setattr(robotiq_ft300, "TRIES", int(PATIENCE))
