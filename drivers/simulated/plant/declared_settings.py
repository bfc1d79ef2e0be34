"""The controller's declared settings: tool, payload, gravity. The plant may differ."""

from __future__ import annotations

from dataclasses import dataclass

from gapbridge.drivers.simulated.plant.kinematics import frame_of
from gapbridge.drivers.simulated.plant.plant_arm import BASE, Frame
from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.plant.rotations import Vector3


@dataclass(slots=True)
class DeclaredSettings:
    """The controller's own settings, changed by scripts."""

    tcp: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # m, rad: TCP in the flange frame
    tool: Frame = BASE  # the same as a frame
    payload_mass: float = 0.0  # kg
    payload_cog: Vector3 = (0.0, 0.0, 0.0)  # m, in the flange frame
    payload_inertia: Vector6 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # kg m^2
    gravity: Vector3 = (0.0, 0.0, 9.80665)  # m/s^2, as set_gravity takes it: upward is positive

    def set_payload(self, mass: float, cog: Vector3) -> None:
        """Declare the payload, kg and m in the flange frame."""
        self.payload_mass, self.payload_cog = mass, cog

    def set_payload_inertia(self, inertia: Vector6) -> None:
        """Declare the payload's inertia, kg m^2."""
        self.payload_inertia = inertia

    def set_gravity(self, gravity: Vector3) -> None:
        """Declare gravity, m/s^2, upward positive."""
        self.gravity = gravity

    def set_tcp(self, tcp: Vector6) -> None:
        """Declare the TCP."""
        self.tcp, self.tool = tcp, frame_of(tcp)
