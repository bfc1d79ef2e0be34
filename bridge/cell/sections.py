"""Sections of the cell file that the daemon uses: link, limits, setpoints, recording.

These pydantic models import no robot library: a cell can be read without one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from gapbridge.bridge.cell.settings.recording import RecordingSettings as RecordingSettings
from gapbridge.drivers.addresses import is_loopback
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.modbus.settings import ModbusSettings
from gapbridge.drivers.replay.settings import ReplaySettings
from gapbridge.drivers.section import Section
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

DEFAULT_DRIVER = "ur_rtde"


def _driver_of(link: Any) -> Any:
    """Return the name of the driver in a link's keys or settings."""
    if isinstance(link, dict):
        name = link.get("driver", DEFAULT_DRIVER)
        return "" if name is None else str(name)  # a value forgotten is no driver either
    return getattr(link, "driver", DEFAULT_DRIVER)


LinkSettings = Annotated[
    Annotated[UrRtdeSettings, Tag("ur_rtde")]
    | Annotated[ModbusSettings, Tag("modbus")]
    | Annotated[CanSettings, Tag("can")]
    | Annotated[CanopenSettings, Tag("canopen")]
    | Annotated[ReplaySettings, Tag("replay")],
    Discriminator(_driver_of),
]
"""Section ``link``: the settings of the driver that it names (left out: ur_rtde)."""


class LimitSettings(Section):
    """Section ``limits``: bounds of every setpoint, whatever computed it."""

    offset: float = Field(0.010, gt=0.0, le=0.1, description="longest TCP offset, m")
    offset_rotation: float = Field(0.02, gt=0.0, le=0.5, description="largest TCP rotation, rad")
    offset_rate: float = Field(0.05, gt=0.0, le=1.0, description="change of the offset, m/s")
    offset_rotation_rate: float = Field(
        0.1, gt=0.0, le=5.0, description="change of the offset's rotation, rad/s"
    )
    joint_offset: float = Field(0.05, gt=0.0, le=0.5, description="correction of any joint, rad")
    joint_velocity: float | None = Field(
        None, gt=0.0, description="of any joint, rad/s; left out: the arm's own limits"
    )
    velocity_share: float = Field(
        1.0, gt=0.0, le=1.0, description="share of the arm's own velocity limits that may be used"
    )
    joint_margin: float = Field(
        0.0, ge=0.0, description="distance kept from the arm's joint limits, rad"
    )
    following: float = Field(
        0.1, gt=0.0, le=0.5, description="largest distance of a command from the actual joint, rad"
    )
    zero_slip: float = Field(
        0.003,
        ge=0.0,
        le=0.1,
        description="slip of a joint's zero at which `run` holds, rad; 0: not watched",
    )
    ramp_time: float = Field(
        0.5, gt=0.0, le=10.0, description="shortest time in which offsets ramp in and out, s"
    )


class SetpointSettings(Section):
    """Section ``setpoints``: where nominal setpoints come from, and whether they are written."""

    source: Literal["target", "trajectory", "planner", "tcp", "modbus"] = "target"
    arm: bool = Field(False, description="true: `run` writes setpoints; false: it only observes")
    file: Path | None = Field(None, description="trajectory: CSV of timestamp, target_q_i")
    socket: Path | None = Field(
        None, description="planner: the Unix socket; left out: one in the daemon's runtime folder"
    )
    token_file: Path | None = Field(
        None, description="tcp: a file that only its owner reads (mode 0600), with the token"
    )
    host: str = Field("127.0.0.1", description="tcp, modbus: address to listen on, loopback only")
    port: int = Field(30310, ge=0, le=65535, description="tcp, modbus: port to listen on")
    timeout: float = Field(
        0.2,
        gt=0.0,
        le=5.0,
        description="planner, tcp, modbus: s without a setpoint after which the source is dry",
    )
    start_tolerance: float = Field(
        0.02, gt=0.0, le=0.2, description="largest distance of the first setpoint from the arm, rad"
    )
    use_force: bool = Field(True, description="whether the measured TCP force bends the model")
    force_filter: float = Field(
        0.05, ge=0.0, le=5.0, description="time constant of the low-pass on the TCP force, s"
    )

    @field_validator("host")
    @classmethod
    def _loopback(cls, value: str) -> str:
        """Refuse addresses that other hosts can reach: whoever writes there moves the arm."""
        if not is_loopback(value):
            raise ValueError("expected a loopback address (127.x.x.x, ::1)")
        return value

    @model_validator(mode="after")
    def _tcp_is_guarded(self) -> Self:
        """Refuse a TCP port without a token: any local program or web page could write to it."""
        if self.source == "tcp" and self.token_file is None:
            raise ValueError(
                "setpoints.token_file: found nothing with source: tcp, expected a file of mode "
                "0600 with a token (openssl rand -hex 32), or source: planner, a Unix socket"
            )
        return self
