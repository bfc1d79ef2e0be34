"""What the examples of Universal Robots' own client library ask of dashboard and port 30001."""

from __future__ import annotations

import socket
import struct

from simulated_controller import SimulatedController

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
