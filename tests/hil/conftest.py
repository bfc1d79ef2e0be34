"""Options of the tests on real hardware: ``pytest tests/hil --cell my-cell.yaml``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.core.errors import GapbridgeError
from gapbridge.drivers import make_driver
from gapbridge.drivers.driver import Driver

CONTRACT = Path(__file__).parents[1] / "drivers" / "contract"
if str(CONTRACT) not in sys.path:
    sys.path.insert(0, str(CONTRACT))


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("hardware in the loop")
    group.addoption("--cell", type=Path, help="the cell file of the robot to test")
    group.addoption(
        "--allow-motion", action="store_true",
        help="also write: the arm moves by 0.2 mm (offsets) or 0.5 degree (joints)",
    )  # fmt: skip


@pytest.fixture(scope="session")
def cell(pytestconfig: pytest.Config) -> Cell:
    path = pytestconfig.getoption("--cell", None)
    if path is None:
        pytest.skip("no robot: give its cell, pytest tests/hil --cell my-cell.yaml")
    try:
        found = load_cell(path)
        link = found.link
    except GapbridgeError as error:
        pytest.exit(str(error), 2)
    if link is None:
        pytest.exit(f"{path}: link: found nothing, expected the robot's address", 2)
    return found


@pytest.fixture
def driver(cell: Cell) -> Iterator[Driver]:
    assert cell.link is not None
    with make_driver(cell.link, cell.model) as found:
        yield found


@pytest.fixture
def motion(pytestconfig: pytest.Config) -> None:
    if not pytestconfig.getoption("--allow-motion", False):
        pytest.skip("the arm must not move: give --allow-motion")
