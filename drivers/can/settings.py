"""The link to an arm on CAN: what a cell file says under ``link``."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Literal

from pydantic import Field

from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.profile_settings import ProfileSettings

SHIPPED = Path(__file__).with_name("profiles")


class CanSettings(ProfileSettings, BusSettings):
    """How to reach an arm on CAN, and which map of frames it has.

    ``profile`` is the name of a shipped one (``piper``, ``openarm``, ``odrive``) or a path ending
    in .yaml, relative to the cell's folder.
    """

    shipped: ClassVar[Path] = SHIPPED
    driver: Literal["can"] = "can"
    profile: str = Field(min_length=1, description="a shipped map of frames, or a path to one")
    direction: tuple[Literal[1, -1], ...] | None = Field(
        None, description="sign of each joint on the wire; left out: the profile's"
    )
    zero: tuple[float, ...] | None = Field(
        None, description="rad of each joint at the wire's zero; left out: the profile's"
    )
    gear: tuple[float, ...] | None = Field(
        None, description="wire turns per joint turn, per joint; left out: the profile's"
    )
    rate: float = Field(200.0, gt=0.0, le=1000.0, description="cycles per second asked for")
    send_timeout: float = Field(
        0.005, gt=0.0, le=0.25, description="s that one frame may take to leave"
    )
    foreign_quiet: float = Field(
        1.0, gt=0.0, le=10.0,
        description="s without a frame of another commander before we may write",
    )  # fmt: skip
    frozen_after: float = Field(
        0.5, gt=0.0, le=10.0,
        description="s that joints may stand still, bit by bit, though they are commanded away",
    )  # fmt: skip
    frozen_distance: float = Field(
        0.02, gt=0.0, le=0.5, description="rad of command from joint that counts as away"
    )
    arming_distance: float = Field(
        0.03, gt=0.0, le=0.3, description="rad that a joint may give while it is enabled"
    )

    @property
    def installation(self) -> dict[str, list[float]]:
        """Return what this arm's installation says instead of the profile."""
        given = {name: getattr(self, name) for name in ("direction", "zero", "gear")}
        return {name: list(value) for name, value in given.items() if value is not None}

    def read_files(self) -> None:
        """Read profile and DBC; see DriverSettings."""
        from gapbridge.drivers.can.loading import read_profile

        read_profile(self.profile_path, self.installation)
