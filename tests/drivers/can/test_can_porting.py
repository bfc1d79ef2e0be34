"""docs/porting.md, the CAN part: its map works as it stands there."""

import re
from pathlib import Path

import numpy as np
import pytest
from can_arm import MODEL, next_state, setpoint_of
from ports import free_port, own_host

from benchmarks.server_thread import ServerThread
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.server import make_servers
from gapbridge.drivers.simulated.server.arm_controller import make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

PAGE = Path(__file__).parents[3] / "docs" / "porting.md"
HOST = own_host()
HALF = np.radians(0.005)


@pytest.fixture
def folder(tmp_path):
    part = PAGE.read_text().split("## CAN: an arm from its DBC")[1].split("\n## ")[0]
    (dbc,) = re.findall(r"```text\n(VERSION.*?)```", part, re.DOTALL)
    (profile,) = re.findall(r"```yaml\n(name: .*?)```", part, re.DOTALL)
    (tmp_path / "my_can_arm.dbc").write_text(dbc)
    (tmp_path / "my_can_arm.yaml").write_text(profile)
    return tmp_path


def test_the_page_s_arm_is_read_armed_and_moved(folder):
    settings = CanSettings(
        profile="my_can_arm.yaml", interface="socketcand", host=HOST, port=free_port(HOST),
        state_timeout=0.5, foreign_quiet=0.1,
    ).located(folder)  # fmt: skip
    controller = make_controller(*simulated_arm(MODEL.arm, seed=2), period=0.004)
    servers = make_servers(settings, HOST, controller)
    with (
        ServerThread(controller, servers, HOST),
        CanDriver(settings, MODEL, clock=SYSTEM) as driver,
    ):
        assert driver.rate == 100.0
        state = next_state(driver)
        assert state.actual_q == pytest.approx(controller.q, abs=HALF * 1.01)
        driver.arm(state)
        goal = state.actual_q + np.linspace(0.01, -0.01, 6)
        driver.write_setpoint(setpoint_of(goal))
        for _ in range(30):
            state = next_state(driver)
        assert np.abs(goal - controller.q).max() < 1.1 * HALF
        assert state.actual_q == pytest.approx(goal, abs=2.1 * HALF)
