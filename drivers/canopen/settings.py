"""The link to CiA 402 drives: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from gapbridge.core.files import read_bytes
from gapbridge.drivers.can_bus.bus import ArmBusSettings
from gapbridge.drivers.link_settings import ProfileSettings


class CanopenSettings(ProfileSettings, ArmBusSettings):
    """How to reach an arm of CiA 402 drives, and which profile describes it.

    ``profile`` is the name of a shipped one (``lwa4p``, ``cia402``) or a path ending in .yaml,
    relative to the cell's folder.
    """

    shipped = Path(__file__).with_name("profiles")
    driver: Literal["canopen"] = "canopen"
    bitrate: int = Field(500_000, ge=10_000, le=1_000_000, description="bit/s")
    rate: float = Field(
        100.0, gt=0.0, le=1000.0, description="SYNCs per second; at most the profile's"
    )
    sdo_timeout: float = Field(0.3, gt=0.0, le=5.0, description="s that one SDO answer may take")
    listen: float = Field(
        0.2, ge=0.0, le=10.0,
        description="s of listening for another master before anything is sent",
    )  # fmt: skip
    clear_faults: bool = Field(False, description="whether arming resets the drives' faults")
    arming_time: float = Field(
        5.0, gt=0.0, le=30.0, description="s that the drives' state machines may take"
    )

    def read_files(self) -> None:
        """Read profile and EDS; see DriverSettings."""
        from gapbridge.drivers.canopen.profile import read_profile

        read_bytes(read_profile(self.profile_path).eds.path)
