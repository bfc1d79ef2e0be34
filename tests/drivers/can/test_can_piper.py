import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from can_arm import next_state
from patience import PATIENCE, wait_for
from piper_sdk import C_PiperInterface_V2
from piper_sdk.kinematics.piper_fk import C_PiperForwardKinematics
from ports import free_port, own_host

from benchmarks.server_thread import ServerThread
from gapbridge.bridge.cell import load_cell
from gapbridge.drivers.can.driver import CanDriver
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.server import make_servers
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.server.arm_controller import make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

CONFIG = Path(__file__).parents[3] / "config"
HOST = own_host()
CELL = CONFIG / "piper_can_simulated.yaml"
START = (0.1, 1.2, -1.0, 0.2, 0.5, -0.3)


def test_the_cells_arm_is_the_one_of_the_vendors_kinematics():
    arm = load_cell(CELL).arm
    for q in (START, (0.0,) * 6, (-1.0, 2.0, -2.5, 1.0, -1.0, 1.5)):
        x, y, z, *_ = C_PiperForwardKinematics(1).CalFK(list(q))[-1]
        ours = plant_arm(arm).flange(q).origin
        assert ours == pytest.approx([x / 1e3, y / 1e3, z / 1e3], abs=1e-9)


@pytest.fixture
def served():
    cell = load_cell(CELL)
    controller = make_controller(*simulated_arm(cell.arm, seed=3, start_q=START), period=0.004)
    link = CanSettings(
        profile="piper", interface="socketcand", host=HOST, port=free_port(HOST), state_timeout=0.5
    )
    with ServerThread(controller, make_servers(link, HOST, controller), HOST):
        yield controller, link, cell.model


@pytest.fixture
def vendor(served, monkeypatch):
    _, link, _ = served
    monkeypatch.setenv("CAN_CONFIG", json.dumps({"host": link.host, "port": link.port}))
    sdk = C_PiperInterface_V2("can0", judge_flag=False, can_auto_init=False)
    sdk.CreateCanBus("can0", bustype="socketcand", judge_flag=False)
    sdk.ConnectPort()
    yield sdk
    sdk.DisconnectPort()


def joints_of(sdk):
    reported = sdk.GetArmJointMsgs().joint_state
    return np.radians([getattr(reported, f"joint_{i}") * 1e-3 for i in range(1, 7)])


def test_the_vendors_client_reads_and_commands_our_arm_and_we_notice_it(served, vendor):
    controller, link, model = served
    wait_for(lambda: np.abs(joints_of(vendor) - controller.q).max() < 1e-5, "its joints")
    with CanDriver(link, model, clock=SYSTEM) as driver:
        assert next_state(driver).actual_q == pytest.approx(controller.q, abs=1e-5)
        until = time.monotonic() + PATIENCE
        while not vendor.EnablePiper():
            assert time.monotonic() < until
            time.sleep(0.05)
        goal = np.array(START) + 0.05
        counts = [round(v) for v in np.degrees(goal) * 1e3]

        def command():
            vendor.MotionCtrl_2(0x01, 0x01, 100, 0x00)
            vendor.JointCtrl(*counts)
            next_state(driver)
            return np.abs(goal - controller.q).max() < 1e-4

        wait_for(command, "the commanded joints")
        state = next_state(driver)
        assert state.target_q == pytest.approx(goal, abs=1e-5)  # another's, but heard
        wait_for(lambda: vendor.GetArmStatus().arm_status.ctrl_mode == 1, "the vendor's status")
        wait_for(lambda: np.abs(joints_of(vendor) - goal).max() < 1e-4, "the vendor's joints")


@pytest.mark.slow
def test_simulate_serves_the_cell_to_another_process(tmp_path):
    cell = tmp_path / "cell.yaml"
    text = CELL.read_text().replace("127.0.0.2", HOST).replace("piper.urdf", "p.urdf")
    text = text.replace("state_timeout: 0.1", "state_timeout: 1.0")
    cell.write_text(text)
    (tmp_path / "p.urdf").write_text((CONFIG / "piper.urdf").read_text())
    code = [sys.executable, "-m", "gapbridge", "simulate", str(cell)]
    with subprocess.Popen(code, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            lines = [server.stdout.readline(), server.stdout.readline()]
            assert "CAN (piper)" in lines[0]
            assert lines[1] == f"ready {HOST}\n"
            found = load_cell(cell)
            with CanDriver(found.link, found.model, clock=SYSTEM) as driver:
                q = [next_state(driver).actual_q for _ in range(50)][-1]
            assert q == pytest.approx(found.file.simulation.start_q, abs=1e-4)
        finally:
            os.kill(server.pid, signal.SIGTERM)
            server.wait(PATIENCE)
