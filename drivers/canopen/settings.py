"""The link to CiA 402 drives: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from gapbridge.core.files import read_bytes
from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.profile_settings import ProfileSettings

SHIPPED = Path(__file__).with_name("profiles")


class CanopenSettings(ProfileSettings, BusSettings):
    """How to reach an arm of CiA 402 drives, and which profile describes it.

    ``profile`` is the name of a shipped one (``lwa4p``, ``cia402``) or a path ending in .yaml,
    relative to the cell's folder.
    """

    shipped: ClassVar[Path] = SHIPPED
    driver: Literal["canopen"] = "canopen"
    profile: str = Field(min_length=1, description="a shipped profile, or a path to one")
    bitrate: int = Field(500_000, ge=10_000, le=1_000_000, description="bit/s")
    rate: float = Field(
        100.0, gt=0.0, le=1000.0, description="SYNCs per second; at most the profile's"
    )
    sdo_timeout: float = Field(0.3, gt=0.0, le=5.0, description="s that one SDO answer may take")
    listen: float = Field(
        0.2, ge=0.0, le=10.0,
        description="s of listening for another master before anything is sent",
    )  # fmt: skip
    foreign_quiet: float = Field(
        1.0, gt=0.0, le=10.0, description="s without a frame of another master before arming"
    )
    clear_faults: bool = Field(False, description="whether arming resets the drives' faults")
    arming_time: float = Field(
        5.0, gt=0.0, le=30.0, description="s that the drives' state machines may take"
    )
    arming_distance: float = Field(
        0.03, gt=0.0, le=0.3, description="rad that a joint may give while it is enabled"
    )
    frozen_after: float = Field(
        0.5, gt=0.0, le=10.0,
        description="s that joints may stand still, count by count, though commanded away",
    )  # fmt: skip
    frozen_distance: float = Field(
        0.02, gt=0.0, le=0.5, description="rad of command from joint that counts as away"
    )

    def read_files(self) -> None:
        """Read profile and EDS; see DriverSettings."""
        from gapbridge.drivers.canopen.profile import read_profile

        read_bytes(read_profile(self.profile_path).eds.path)
