"""Fixtures of the tests with a running daemon."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_cell import Robot


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep what daemons share (locks, sockets) in a folder of the test's own."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Robot]:
    """Yield a simulated UR10e behind its real protocol."""
    with Robot(tmp_path) as found:
        yield found
