"""What every link's settings have; read by processes that never open a link."""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field


class DriverSettings(BaseModel):
    """What every link says, whatever the driver."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)

    rate: float = Field(500.0, gt=0.0, le=1000.0, description="cycles per second asked for")
    state_timeout: float = Field(
        0.04, gt=0.0, le=1.0,
        description="s without a new controller timestamp after which the state is stale",
    )  # fmt: skip
    connect_timeout: float = Field(
        15.0, gt=0.0, description="s that connecting or arming may take before it counts as hung"
    )

    @property
    def moves_arm(self) -> bool:
        """Return whether setpoints are the arm's motion; False: they ride on the robot's own."""
        return True

    def located(self, folder: Path) -> Self:
        """Return the settings with paths relative to ``folder`` made absolute.

        Raises InputError where a file that they name cannot be used.
        """
        return self

    def read_files(self) -> None:
        """Read, through core.files, all files that the driver will read. Raises InputError."""
