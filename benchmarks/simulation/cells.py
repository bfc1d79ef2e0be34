"""Cells of links that only the simulation has: the table of faults over real wires has its own."""

from __future__ import annotations

import shutil
from pathlib import Path

import yaml

from benchmarks.faults.links import CONFIG, LIMITS, UR, Link, UrServo
from benchmarks.faults.links import LINKS as WIRED
from benchmarks.faults.proxy import Port
from benchmarks.faults.wire.seen import Decoder

ODRIVE = """
robot:
  dh:
    - {a: 0.15, alpha: -1.5707963267948966, d: 0.45, mass: 25.0, cog: [-0.07, 0.0, -0.1]}
    - {a: 0.59, alpha: 0.0, d: 0.0, offset: -1.5707963267948966, mass: 18.0, cog: [-0.3, 0.0, 0.05]}
    - {a: 0.13, alpha: -1.5707963267948966, d: 0.0, mass: 15.0, cog: [-0.06, 0.0, 0.03]}
    - {a: 0.0, alpha: 1.5707963267948966, d: 0.647, mass: 6.0, cog: [0.0, -0.2, 0.0]}
    - {a: 0.0, alpha: -1.5707963267948966, d: 0.0, mass: 3.0, cog: [0.0, 0.0, 0.02]}
    - {a: 0.0, alpha: 0.0, d: 0.095, mass: 0.5, cog: [0.0, 0.0, -0.02]}
tool: {tcp: {xyz: [0, 0, 0.12], rpy: [0, 0, 0]}}
payload: {mass: 6.0, cog: [0, 0, 0.05]}
compliance: &soft
  axial: [1.0e-6, 1.5e-6, 2.0e-6, 4.0e-6, 6.0e-6, 8.0e-6]
  radial: [5.0e-7, 5.0e-7, 5.0e-7, 1.0e-6, 1.0e-6, 1.0e-6]
simulation: {seed: 11, start_q: [0.0, -0.3, 0.6, 0.0, 0.5, 0.0], compliance: *soft}
"""
OPENARM = """
robot: {urdf: seven_axis.urdf, tip: flange}
tool: {tcp: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}
payload: {mass: 1.0, cog: [0, 0, 0.05]}
compliance: &soft
  axial: [1.0e-5, 1.5e-5, 2.0e-5, 2.0e-5, 4.0e-5, 4.0e-5, 4.0e-5]
  radial: [2.0e-6, 2.0e-6, 2.0e-6, 2.0e-6, 4.0e-6, 4.0e-6, 4.0e-6]
simulation: {seed: 11, start_q: [0.0, 0.5, 0.0, -1.2, 0.0, 0.7, 0.0], compliance: *soft}
"""
PROFILES = Path(__file__).parents[2] / "drivers" / "canopen" / "profiles"


class SimulatedOnly(Link):
    """A link whose wires exist in memory only."""

    def ports(self) -> list[Port]:
        """See Link.ports."""
        raise NotImplementedError

    def decoder(self) -> Decoder:
        """See Link.decoder."""
        raise NotImplementedError


class CanopenDrives(SimulatedOnly):
    """Six CiA 402 drives whose PDOs are fixed: the shipped profile's units, one PDO each way."""

    name, usual_rate, moves_arm, base, main = "canopen", 100.0, True, UR, "can"
    grain, grain_rotation = 1e-6, 1e-6  # a position count of each joint
    profile = "fixed.yaml"

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: canopen, profile: {self.profile}, interface: virtual, "
            f"rate: {self.rate:g}, state_timeout: {self.hold}, listen: 0.05, sdo_timeout: 0.1, "
            "arming_time: 1.0, foreign_quiet: 0.3, clear_faults: true}\n"
        )

    def write_cells(self, folder: Path, front: str, back: str, more: str) -> tuple[Path, Path]:
        """See Link.write_cells."""
        shipped = PROFILES / "cia402.yaml"
        profile = yaml.safe_load(shipped.read_text(encoding="utf-8"))
        profile |= {
            "eds": str(PROFILES / profile["eds"]),
            "pdo_setup": "check",
            "tpdo": {1: ["Statusword", "Position actual value", "Modes of operation display"]},
        }
        folder.mkdir(parents=True, exist_ok=True)
        (folder / self.profile).write_text(yaml.safe_dump(profile), encoding="utf-8")
        return super().write_cells(folder, front, back, more)


class ModbusTarget(SimulatedOnly):
    """An igus controller over Modbus TCP, which has no mailbox: joint targets and a trigger."""

    name, usual_rate, moves_arm, base, main = "modbus target", 50.0, True, UR, "modbus"
    hold = 0.2
    behind = False
    # half a count, 0.087 mrad, of every joint times its distance from the TCP
    grain, grain_rotation = 4e-4, 6e-4

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: modbus, profile: igus, host: {host}, rate: {self.rate:g}, "
            f"timeout: 0.05, state_timeout: {self.hold}, coarsest: 0.001}}\n"
        )


class UrWithSensor(UrServo):
    """UR by servoJ, forces by a sensor on the flange."""

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"{super().section(host)}"
            "ft_sensor: {driver: robotous_rft, interface: virtual, rate: 50, when_lost: stop}\n"
        )


class CanNodesInMemory(SimulatedOnly):
    """An arm of its own on CAN, by a shipped profile."""

    usual_rate, moves_arm, main = 100.0, True, "can"
    profile: str
    more = ""  # keys of the link

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"link: {{driver: can, profile: {self.profile}, interface: virtual, "
            f"rate: {self.rate:g}, state_timeout: {self.hold}, foreign_quiet: 0.3{self.more}}}\n"
        )


class OdriveAxes(CanNodesInMemory):
    """Six ODrive axes behind gears."""

    name = profile = "odrive"
    base = ODRIVE
    start_q = (0.0, -0.3, 0.6, 0.0, 0.5, 0.0)
    grain, grain_rotation = 1e-6, 2e-6  # turns are floats of 24 bits
    more = ", gear: [50, 50, 50, 20, 20, 20], direction: [1, 1, -1, 1, -1, 1]"

    def write_cells(self, folder: Path, front: str, back: str, more: str) -> tuple[Path, Path]:
        """See Link.write_cells: DH rows carry no limits."""
        limited = LIMITS.replace("limits:\n", "limits:\n  joint_velocity: 1.0\n")
        return super().write_cells(folder, front, back, more or limited)


class OpenArmMotors(CanNodesInMemory):
    """Seven actuators in MIT mode."""

    name = profile = "openarm"
    base = OPENARM
    start_q = (0.0, 0.5, 0.0, -1.2, 0.0, 0.7, 0.0)
    # half a count, 0.19 mrad, of every joint times its distance from the TCP
    grain, grain_rotation = 7e-4, 1.4e-3

    def write_cells(self, folder: Path, front: str, back: str, more: str) -> tuple[Path, Path]:
        """See Link.write_cells."""
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(CONFIG / "seven_axis.urdf", folder / "seven_axis.urdf")
        return super().write_cells(folder, front, back, more)


CELLS: dict[str, type[Link]] = {
    **WIRED, "canopen": CanopenDrives, "ur_sensor": UrWithSensor, "odrive": OdriveAxes,
    "openarm": OpenArmMotors, "modbus_target": ModbusTarget,
}  # fmt: skip
"""Link -> its cell, and what it promises."""
