"""What the examples of Universal Robots' own client library ask of dashboard and port 30001."""

from __future__ import annotations

import socket
import struct

from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.ur import modes
from gapbridge.drivers.simulated.ur.servers.dashboard_server import DashboardServer
from gapbridge.drivers.simulated.ur.servers.primary_server import PrimaryServer
from gapbridge.drivers.simulated.ur.settings import make_controller, simulated_cell
from gapbridge.drivers.ur_rtde.enquiry import CONFIGURATION, STATE, _parts

UR10 = 2  # RobotType of the client library, for the e-Series too


def test_the_configuration_names_the_arm_type(controller: SimulatedController) -> None:
    found = None
    with socket.create_connection((controller.host, 30001), 5) as link, link.makefile("rb") as s:
        while found is None:
            size, kind = struct.unpack(">ib", s.read(5))
            body = s.read(size - 5)
            if kind == STATE:
                found = dict(_parts(body)).get(CONFIGURATION)
    assert struct.unpack(">4i", found[-16:])[2] == UR10


def test_the_dashboard_flushes_its_log(controller: SimulatedController) -> None:
    with socket.create_connection((controller.host, 29999), 5) as link, link.makefile("r") as s:
        s.readline()
        link.sendall(b"saveLog\n")
        assert s.readline() == "Log saved to disk\n"


def test_the_robot_mode_data_tell_a_pause_power_and_the_slider() -> None:
    controller = make_controller(simulated_cell("ur10e"))
    server = PrimaryServer(controller, (5, 15, 0), (), ())
    dashboard = DashboardServer(controller, "5.15.0.0", "1")

    def reported() -> tuple[bool, bool, bool, float]:
        """Return power_on, program_running, program_paused, target_speed_fraction."""
        fields = struct.unpack(">Q7?bB3dB", server._mode()[5:])
        return fields[3], fields[6], fields[7], fields[10]

    dashboard.answer("load job.urp")
    dashboard.answer("play")
    for _ in range(50):
        controller.cycle()
    controller.write_inputs({"speed_slider_mask": 1, "speed_slider_fraction": 0.3})
    assert reported() == (True, True, False, 0.3)
    dashboard.answer("pause")
    assert reported() == (True, False, True, 0.3)
    dashboard.answer("stop")
    controller.set_robot_mode(modes.IDLE)
    assert reported() == (True, False, False, 0.3)
    dashboard.answer("power off")
    assert reported() == (False, False, False, 0.3)
