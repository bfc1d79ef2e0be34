"""Cells of links that only the simulation has: the table of faults over real wires has its own."""

from __future__ import annotations

from pathlib import Path

import yaml

from benchmarks.faults.links import LINKS as WIRED
from benchmarks.faults.links import UR, Link, UrServo
from benchmarks.faults.proxy import Port
from benchmarks.faults.wire.seen import Decoder

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


class UrWithSensor(UrServo):
    """UR by servoJ, forces by a sensor on the flange."""

    def section(self, host: str) -> str:
        """See Link.section."""
        return (
            f"{super().section(host)}"
            "ft_sensor: {driver: robotous_rft, interface: virtual, rate: 50, when_lost: stop}\n"
        )


CELLS: dict[str, type[Link]] = {**WIRED, "canopen": CanopenDrives, "ur_sensor": UrWithSensor}
"""Link -> its cell, and what it promises."""
