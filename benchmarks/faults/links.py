"""The links on which faults are made: a cell for the daemon, one for the controller, a tap."""

from __future__ import annotations

import math
import shutil
import socket
import time
from abc import ABC, abstractmethod
from pathlib import Path

from benchmarks.faults.controller_process import ControllerProcess
from benchmarks.faults.invariants import Bounds
from benchmarks.faults.proxy import Port
from benchmarks.faults.splitting import ModbusFrames, Raw, RtdeFrames, SocketcandMessages
from benchmarks.faults.wire.modbus import ModbusDecoder
from benchmarks.faults.wire.rtde import RtdeDecoder
from benchmarks.faults.wire.seen import Decoder
from benchmarks.faults.wire.socketcand import PiperDecoder
from benchmarks.server_thread import OFFSET_SCRIPT
from gapbridge.bridge.cell import load_cell
from gapbridge.drivers.simulated.plant.kinematics import frame_of
from gapbridge.drivers.simulated.plant.plant_arm import plant_arm
from gapbridge.drivers.simulated.ur.settings import START_Q

CONFIG = Path(__file__).parents[2] / "config"
CONNECT = 3.0  # s that the library may hang in its constructor before its process is ended
OFFSET, ROTATION, OFFSET_RATE, ROTATION_RATE = 0.002, 0.01, 0.008, 0.08
LIMITS = f"""
limits:
  offset: {OFFSET}
  offset_rotation: {ROTATION}
  offset_rate: {OFFSET_RATE}
  offset_rotation_rate: {ROTATION_RATE}
  ramp_time: 0.05
recording: {{folder: null}}
"""
UR = """
robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.18], rpy: [0, 0, 0]}}
payload: {mass: 5.0, cog: [0, 0, 0.06]}
compliance: &soft
  axial: [2.0e-6, 3.0e-6, 4.0e-6, 8.0e-6, 8.0e-6, 8.0e-6]
  radial: [1.0e-6, 1.0e-6, 1.0e-6, 2.0e-6, 2.0e-6, 2.0e-6]
simulation: {seed: 11, compliance: *soft}
"""
PIPER = """
robot: {urdf: piper.urdf, tip: link6}
tool: {tcp: {xyz: [0, 0, 0.1358], rpy: [0, 0, 0]}}
payload: {mass: 1.0, cog: [0, 0, 0.06]}
compliance: &soft
  axial: [3.0e-5, 6.0e-5, 8.0e-5, 1.0e-4, 1.2e-4, 1.2e-4]
  radial: [5.0e-6, 8.0e-6, 1.0e-5, 1.0e-5, 2.0e-5, 2.0e-5]
simulation: {seed: 1, start_q: [0.0, 1.5, -1.2, 0.0, 0.6, 0.0], compliance: *soft}
"""


class Link(ABC):
    """One kind of link. ``rate`` is in Hz; ``hold`` (s) is after what silence the offset goes."""

    name: str
    start_q: tuple[float, ...] = START_Q
    usual_rate: float
    moves_arm: bool
    base: str
    main: str  # name of the port that states come over
    hold = 0.1
    grain, grain_rotation = 1e-8, 1e-8
    burst = 0.0
    withdraws = math.inf  # s of silence after which the robot's own program withdraws offsets
    behind = True  # a client may have been sent more than it has read; not where it has to ask

    def __init__(self, rate: float | None = None) -> None:
        self.rate = rate or self.usual_rate

    @property
    def cycle(self) -> float:
        """Return the duration of a cycle, s."""
        return 1.0 / self.rate

    @property
    def fresh(self) -> float:
        """Return how old the state behind a write may be, s: the daemon's promise."""
        return max(0.04, 5.0 / self.rate)

    @abstractmethod
    def section(self, host: str) -> str:
        """Return section ``link`` of a cell whose controller is at ``host``."""

    @abstractmethod
    def ports(self) -> list[Port]:
        """Return the ports that the proxy serves."""

    @abstractmethod
    def decoder(self) -> Decoder:
        """Return a decoder of what goes over the wire."""

    def prepare(self, controller: ControllerProcess, host: str, writing: bool = False) -> None:
        """Do what a person does at the robot before it can be armed (again).

        ``writing``: the daemon compensates, so that nothing needs to be done to programs.
        """

    def write_cells(self, folder: Path, front: str, back: str, more: str) -> tuple[Path, Path]:
        """Write the daemon's cell, whose controller is at ``front``, and the controller's.

        ``more``: further sections of the daemon's, in place of limits and recording where given.
        """
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(CONFIG / "piper.urdf", folder / "piper.urdf")
        cells = []
        for name, host in (("daemon", front), ("controller", back)):
            path = folder / f"{name}.yaml"
            extra = (more or LIMITS) if name == "daemon" else ""
            path.write_text(self.base + self.section(host) + extra, encoding="utf-8")
            cells.append(path)
        return cells[0], cells[1]

    def bounds(self, cell: Path) -> Bounds:
        """Return what the daemon's cell allows, for the checker."""
        found = load_cell(cell)
        limits = found.limits
        tcp = found.file.tool.tcp
        tool = frame_of((*tcp.xyz, 0.0, 0.0, 0.0))  # tools here are not turned
        return Bounds(
            plant_arm(found.arm), tool, limits.offset, limits.offset_rotation, limits.offset_rate,
            limits.offset_rotation_rate, 1.0 / self.rate, self.grain, self.grain_rotation,
            self.fresh, self.burst, self.fresh if self.behind else 0.0,
            self.withdraws,
        )  # fmt: skip


class UrServo(Link):
    """UR by servoJ: our setpoints are the arm's motion."""

    name, usual_rate, moves_arm, base, main = "ur_rtde servoj", 250.0, True, UR, "rtde"
    mode = "servoj"
    grain, grain_rotation = 2e-6, 4e-6  # a limited offset is shared out by joints, to first order

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: ur_rtde, host: {host}, mode: {self.mode}, rate: {self.rate:g}, "
            f"state_timeout: {self.hold}, watchdog: 4, connect_timeout: {CONNECT}}}\n"
        )

    def ports(self) -> list[Port]:
        """See Link.ports."""
        return [
            Port("rtde", 30004, RtdeFrames), Port("script", 30003, Raw),
            Port("dashboard", 29999, Raw),
        ]  # fmt: skip

    def decoder(self) -> Decoder:
        """See Link.decoder."""
        return RtdeDecoder(servoj=self.mode == "servoj")

    def prepare(self, controller: ControllerProcess, host: str, writing: bool = False) -> None:
        """Leave the robot without a program and ready to move."""
        self._make_ready(controller, host, writing)

    def _make_ready(self, controller: ControllerProcess, host: str, writing: bool) -> None:
        controller.bench("thaw")
        controller.bench("release")
        controller.bench("unlock")
        if "RUNNING" not in dashboard(host, "robotmode"):
            dashboard(host, "power on")
            time.sleep(0.05)
            dashboard(host, "brake release")
            time.sleep(0.05)
        if self.mode == "servoj" and not writing and "true" in dashboard(host, "running"):
            dashboard(host, "stop")


class UrOffset(UrServo):
    """UR by offsets in registers that the robot's own program applies."""

    name, usual_rate, moves_arm, mode = "ur_rtde offset", 125.0, False, "offset"
    grain, grain_rotation = 2e-8, 2e-8
    withdraws = 0.2  # gb_silence of gapbridge_offset.script

    def prepare(self, controller: ControllerProcess, host: str, writing: bool = False) -> None:
        """Have the robot's own program run."""
        self._make_ready(controller, host, writing)
        if "true" not in dashboard(host, "running"):
            self.start_program(host)

    @staticmethod
    def start_program(host: str) -> None:
        """Send the program to the robot."""
        with socket.create_connection((host, 30003), timeout=5.0) as upload:
            upload.sendall(OFFSET_SCRIPT.read_bytes())
            time.sleep(0.2)


class Modbus(Link):
    """A UR controller's Modbus server, offsets through the mailbox."""

    name, usual_rate, moves_arm, base, main = "modbus mailbox", 50.0, False, UR, "modbus"
    hold = 0.2
    port = 15020
    withdraws = 0.5  # watchdog of drivers/modbus/profiles/ur.yaml
    grain, grain_rotation = 2e-6, 2e-6
    behind = False

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: modbus, profile: ur, host: {host}, port: {self.port}, "
            f"rate: {self.rate:g}, timeout: 0.05, state_timeout: {self.hold}}}\n"
        )

    def ports(self) -> list[Port]:
        """See Link.ports."""
        return [Port("modbus", self.port, ModbusFrames)]

    def decoder(self) -> Decoder:
        """See Link.decoder."""
        return ModbusDecoder()

    def prepare(self, controller: ControllerProcess, host: str, writing: bool = False) -> None:
        """Clear stops; have the mailbox program run."""
        for line in ("thaw", "release", "unlock", "program 1"):
            controller.bench(line)


class CanPiper(Link):
    """An AgileX PiPER on a bus between processes."""

    name, usual_rate, moves_arm, base, main = "can piper", 200.0, True, PIPER, "can"
    port = 29536
    start_q = (0.0, 1.5, -1.2, 0.0, 0.6, 0.0)
    grain, grain_rotation = 2e-5, 6e-5  # 0.001 degrees of each joint

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: can, profile: piper, interface: socketcand, host: {host}, "
            f"port: {self.port}, rate: {self.rate:g}, state_timeout: {self.hold}, "
            "foreign_quiet: 0.3}\n"
        )

    def ports(self) -> list[Port]:
        """See Link.ports."""
        return [Port("can", self.port, SocketcandMessages)]

    def decoder(self) -> Decoder:
        """See Link.decoder."""
        return PiperDecoder()

    def prepare(self, controller: ControllerProcess, host: str, writing: bool = False) -> None:
        """Clear stops."""
        for line in ("thaw", "release", "unlock", "resume"):
            controller.bench(line)


def dashboard(host: str, line: str) -> str:
    """Say a line to a UR's dashboard; returns the answer."""
    with socket.create_connection((host, 29999), timeout=5.0) as link:
        answers = link.makefile("r")
        answers.readline()
        link.sendall(line.encode() + b"\n")
        return answers.readline().strip()


LINKS: dict[str, type[Link]] = {
    "ur_servoj": UrServo,
    "ur_offset": UrOffset,
    "modbus": Modbus,
    "can": CanPiper,
}
"""The links of the table of faults."""
