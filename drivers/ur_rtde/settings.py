"""The link to a UR controller: what a cell file says under ``link``."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gapbridge.drivers.link_settings import DriverSettings
from gapbridge.drivers.section import PlainHost, Positive

Constants = Annotated[tuple[Positive, ...], Field(min_length=6, max_length=6)]


class UrRtdeSettings(DriverSettings):
    """How to reach a UR controller and how setpoints get there.

    Two modes of writing: ``servoj`` streams joint setpoints through the library's own control
    script, and moves the arm itself; ``offset`` leaves the motion to the robot's own program, which
    holds ``gapbridge_offset.script``, and sends the Cartesian offset only.
    """

    driver: Literal["ur_rtde"] = "ur_rtde"
    host: PlainHost = Field("127.0.0.2", description="the controller's IPv4 address or name")
    mode: Literal["servoj", "offset"] = "servoj"
    lookahead: float = Field(0.1, ge=0.03, le=0.2, description="servoj: lookahead time, s")
    gain: float = Field(300.0, ge=100.0, le=2000.0, description="servoj: proportional gain")
    watchdog: float = Field(
        10.0, ge=1.0, le=100.0,
        description="servoj: the robot stops where no setpoint comes at this rate, Hz",
    )  # fmt: skip
    stop_deceleration: float = Field(
        2.0, gt=0.0, le=20.0, description="servoj: tool deceleration at the end, m/s^2"
    )
    following: float = Field(
        0.5, gt=0.0, le=2.0,
        description="servoj: s after which the controller's target must have come to a setpoint",
    )  # fmt: skip
    echo: float = Field(
        0.1, gt=0.0, le=1.0,
        description="offset: s after which the robot's program must have echoed an offset",
    )  # fmt: skip
    tcp_tolerance: float = Field(
        0.005, gt=0.0, le=0.05,
        description="m that the controller's TCP may be from the cell's; offset: while armed too",
    )  # fmt: skip
    remote_control: bool = Field(
        True, description="servoj: refuse where the robot is not in remote control"
    )
    torque_constants: Constants | None = Field(
        None,
        description="Nm/A of each joint motor current; without them there is no joint torque",
    )

    @property
    def moves_arm(self) -> bool:
        """Return whether setpoints are the arm's motion."""
        return self.mode == "servoj"
