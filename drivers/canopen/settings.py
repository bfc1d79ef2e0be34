"""The link to CiA 402 drives: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field

from gapbridge.core.errors import InputError
from gapbridge.core.files import read_bytes
from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.driver import DriverSettings

SHIPPED = Path(__file__).with_name("profiles")


class CanopenSettings(DriverSettings, BusSettings):
    """How to reach an arm of CiA 402 drives, and which profile describes it.

    ``profile`` is the name of a shipped one (``lwa4p``, ``cia402``) or a path ending in .yaml,
    relative to the cell's folder.
    """

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

    @property
    def names_file(self) -> bool:
        """Return whether ``profile`` is a path rather than a shipped name."""
        return self.profile.endswith((".yaml", ".yml"))

    @property
    def profile_path(self) -> Path:
        """Return the file of the profile."""
        return Path(self.profile) if self.names_file else SHIPPED / f"{self.profile}.yaml"

    def read_files(self) -> None:
        """Read profile and EDS; see DriverSettings."""
        from gapbridge.drivers.canopen.profile import read_profile

        read_bytes(read_profile(self.profile_path).eds.path)

    def located(self, folder: Path) -> Self:
        """Return the settings with the profile's path resolved; see DriverSettings."""
        if self.names_file:
            return self.model_copy(update={"profile": str((folder / self.profile).resolve())})
        if not self.profile_path.is_file():
            shipped = ", ".join(sorted(path.stem for path in SHIPPED.glob("*.yaml")))
            raise InputError(
                f"link.profile: found {self.profile!r}, expected one of {shipped}, or a path "
                "ending in .yaml"
            )
        return self
