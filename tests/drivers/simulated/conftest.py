from __future__ import annotations

from collections.abc import Iterator

import pytest
from simulated_cell import Bench, cell_settings
from simulated_controller import SimulatedController


@pytest.fixture
def controller() -> Iterator[SimulatedController]:
    with SimulatedController(cell_settings(), log_level="INFO") as running:
        yield running


@pytest.fixture
def bench(controller: SimulatedController) -> Iterator[Bench]:
    found = Bench(controller.host)
    yield found
    found.close()
