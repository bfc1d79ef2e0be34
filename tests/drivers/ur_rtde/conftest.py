from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
from driver_runs import Bench, cell_settings, offset_program
from patience import wait_for
from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.ur.settings import SCRIPT_PORT


@pytest.fixture
def controller() -> Iterator[SimulatedController]:
    with SimulatedController(cell_settings(), log_level="INFO") as running:
        yield running


@pytest.fixture
def bench(controller: SimulatedController) -> Iterator[Bench]:
    found = Bench(controller.host)
    yield found
    found.close()


@pytest.fixture
def offset_robot(controller: SimulatedController) -> SimulatedController:
    """A robot whose own program, with ours in it, runs."""
    with socket.create_connection((controller.host, SCRIPT_PORT), timeout=5) as pendant:
        pendant.sendall(offset_program().encode())
        wait_for(lambda: " starts\n" in controller.log(), "the program")
    return controller
