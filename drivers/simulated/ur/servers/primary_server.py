"""Port 30001: clients get a version message and robot states, and may send programs.

Of a state's sub-packages it has the robot mode (0), kinematics info (5) and configuration data (6).
Source: Universal Robots, description of the client interfaces; layouts as in the Universal Robots
client library. All numbers are big-endian.
"""

from __future__ import annotations

import socket
import struct

from gapbridge.drivers.simulated.server.connection import Connection
from gapbridge.drivers.simulated.ur import modes
from gapbridge.drivers.simulated.ur.controller import Controller

EVERY = 50  # cycles of 2 ms between two states: 10 Hz
STATE, MESSAGE, VERSION = 16, 20, 3
MODE, KINEMATICS, CONFIGURATION = 0, 5, 6
ROBOT_TYPES = {"ur5": 1, "ur10": 2, "ur3": 3, "ur16": 4, "ur20": 7, "ur30": 8}
CALIBRATED = 2  # calibration status: linearised
BUILT = b"01-01-2024, 00:00:00"

Rows = tuple[tuple[float, float, float, float], ...]


class PrimaryServer:
    """The primary interface of one controller.

    ``nominal`` and ``calibrated`` are six DH rows (theta, a, d, alpha); without them a state holds
    no kinematics.
    """

    def __init__(
        self, controller: Controller, version: tuple[int, int, int], nominal: Rows, calibrated: Rows
    ) -> None:
        self._controller = controller
        self._version = version
        self._still = b""
        if nominal:
            self._still = _kinematics(calibrated) + _configuration(controller, nominal)
        self._clients: list[Connection] = []
        self._cycles = 0

    def accept(self, sock: socket.socket) -> Connection:
        """Greet a new client with the version message."""
        connection = Connection(sock)
        name, (major, minor, bugfix) = b"UR Controller", self._version
        body = struct.pack(">Qbb", 0, -2, VERSION) + bytes([len(name)]) + name
        body += struct.pack(">BBii", major, minor, bugfix, 0) + BUILT
        connection.send(_package(MESSAGE, body))
        self._clients.append(connection)
        return connection

    def publish(self) -> None:
        """Count a cycle; send a state to every client when due."""
        self._cycles += 1
        if self._cycles % EVERY or not self._clients:
            return
        self._clients = [client for client in self._clients if client.open]
        state = _package(STATE, self._mode() + self._still)
        for client in self._clients:
            if not client.pending:  # never queue
                client.send(state)

    def _mode(self) -> bytes:
        memory = self._controller.memory
        powered = memory["robot_mode"] >= modes.POWER_ON
        playing = memory["runtime_state"] == modes.PLAYING
        paused = memory["runtime_state"] == modes.PAUSED
        stopped = memory["safety_mode"] == modes.SAFETY_PROTECTIVE
        emergency = memory["safety_mode"] == modes.SAFETY_ROBOT_EMERGENCY
        body = struct.pack(
            ">Q7?bB3dB", int(1e6 * self._controller.clock), True, True, powered, emergency, stopped,
            playing, paused, memory["robot_mode"], 0, memory["target_speed_fraction"],
            memory["speed_scaling"], 1.0, 0,
        )  # fmt: skip
        return _part(MODE, body)


def _kinematics(rows: Rows) -> bytes:
    columns = [value for column in zip(*rows, strict=True) for value in column]
    return _part(KINEMATICS, struct.pack(">6I24dI", *[0] * 6, *columns, CALIBRATED))


def _configuration(controller: Controller, rows: Rows) -> bytes:
    arm = controller.plant.arm
    theta, a, d, alpha = zip(*rows, strict=True)
    bounds = [v for pair in zip(arm.lower, arm.upper, strict=True) for v in pair]
    speeds = [v for speed in arm.velocity for v in (speed, 5.0)]
    general = (1.05, 1.4, 0.25, 1.2, 0.25)  # v_joint, a_joint, v_tool, a_tool, eq_radius
    kind = ROBOT_TYPES.get(arm.name.rstrip("e"), 0)
    numbers = (*bounds, *speeds, *general, *a, *d, *alpha, *theta, 0, 0, kind, 0)
    return _part(CONFIGURATION, struct.pack(">12d12d5d24d4i", *numbers))


def _part(kind: int, body: bytes) -> bytes:
    return struct.pack(">IB", 5 + len(body), kind) + body


def _package(kind: int, body: bytes) -> bytes:
    return struct.pack(">ib", 5 + len(body), kind) + body
