"""One rig a link for all tests of it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
for folder in (ROOT, Path(__file__).parent):
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[object]:
    """Return the rigs of a module's tests."""
    from rigs import Rigs

    found = Rigs(tmp_path_factory.mktemp("faults"))
    yield found
    found.close()
