"""Served drives and a driver for tests; makes the tests' modules importable from here."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

if str(Path(__file__).parent) not in sys.path:
    sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def arm(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Serve a DriveArm of generic drives, or of the profile that a test is parametrised with."""
    from drive_arm import served

    with served(getattr(request, "param", "cia402")) as found:
        yield found


@pytest.fixture
def driver(arm: Any) -> Iterator[Any]:
    """Yield a connected driver of the arm."""
    with arm.driver() as found:
        yield found
