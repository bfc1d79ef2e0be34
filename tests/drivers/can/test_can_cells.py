"""Every ready CAN cell that names a simulated bus is served, read, armed and let go."""

from pathlib import Path

import numpy as np
import pytest
from can_arm import next_state
from ports import free_port

from benchmarks.server_thread import ServerThread
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.cell.simulation import served_controller
from gapbridge.core.errors import LinkError
from gapbridge.drivers import make_driver

CONFIG = Path(__file__).parents[3] / "config"
CELLS = [CONFIG / f"{name}_can_simulated.yaml" for name in ("piper", "odrive")]


@pytest.mark.parametrize("path", CELLS, ids=lambda path: path.stem)
def test_a_ready_cell_is_served_read_armed_and_released(path):
    cell = load_cell(path)
    given = {"port": free_port(), "state_timeout": 0.5, "foreign_quiet": 0.1}
    link = cell.link.model_copy(update=given)
    found = served_controller(cell, link)
    with (
        ServerThread(found.controller, found.servers, found.host),
        make_driver(link, cell.model) as driver,
    ):
        state = next_state(driver)
        assert state.actual_q == pytest.approx(cell.file.simulation.start_q, abs=1e-4)
        driver.arm(state)
        assert np.abs(next_state(driver).actual_q - state.actual_q).max() < 1e-4
        driver.release()


def test_the_real_arms_cell_loads_and_its_bus_is_reported_where_it_is_missing():
    cell = load_cell(CONFIG / "piper_can.yaml")
    driver = make_driver(cell.link, cell.model)
    with pytest.raises(LinkError, match=r"socketcan can0: cannot be opened|never heard"):
        driver.connect()
