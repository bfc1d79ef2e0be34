"""The link to an arm on CAN: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from gapbridge.drivers.can_bus.bus import ArmBusSettings
from gapbridge.drivers.link_settings import ProfileSettings
from gapbridge.drivers.section import Number


class CanSettings(ProfileSettings, ArmBusSettings):
    """How to reach an arm on CAN, and which map of frames it has.

    ``profile`` is the name of a shipped one (``piper``, ``openarm``, ``odrive``) or a path ending
    in .yaml, relative to the cell's folder.
    """

    shipped = Path(__file__).with_name("profiles")
    driver: Literal["can"] = "can"
    direction: tuple[Literal[1, -1], ...] | None = Field(
        None, description="sign of each joint on the wire; left out: the profile's"
    )
    zero: tuple[Number, ...] | None = Field(
        None, description="rad of each joint at the wire's zero; left out: the profile's"
    )
    gear: tuple[Number, ...] | None = Field(
        None, description="wire turns per joint turn, per joint; left out: the profile's"
    )
    rate: float = Field(200.0, gt=0.0, le=1000.0, description="cycles per second asked for")
    send_timeout: float = Field(
        0.005, gt=0.0, le=0.25, description="s that one frame may take to leave"
    )

    @property
    def installation(self) -> dict[str, list[float]]:
        """Return the values that replace the profile's for this arm."""
        values = {name: getattr(self, name) for name in ("direction", "zero", "gear")}
        return {name: list(value) for name, value in values.items() if value is not None}

    def read_files(self) -> None:
        """Read profile and DBC; see DriverSettings."""
        from gapbridge.drivers.can.loading import read_profile

        read_profile(self.profile_path, self.installation)
