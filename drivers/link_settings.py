"""Settings that every link has; read also by processes that never open a link."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field

from gapbridge.core.errors import InputError
from gapbridge.core.files import is_file
from gapbridge.drivers.section import Section


class DriverSettings(Section):
    """Settings of a link that every driver has."""

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
        """Return whether setpoints are the arm's motion; False: offsets on the robot's own."""
        return True

    @property
    def largest_offset(self) -> tuple[float, float]:
        """Return the largest offset that can be sent, m and rad. Raises InputError."""
        return math.inf, math.inf

    def read_files(self) -> None:
        """Read, through core.files, all files that the driver will read. Raises InputError."""


class ProfileSettings(DriverSettings):
    """A link with a ``profile``: the name of a shipped one, or a path ending in .yaml.

    Paths are relative to the cell's folder.
    """

    shipped: ClassVar[Path]  # folder of the profiles that the driver ships
    profile: str = Field(min_length=1, description="a shipped profile, or a path to one")

    @property
    def names_file(self) -> bool:
        """Return whether ``profile`` is a path rather than a shipped name."""
        return self.profile.endswith((".yaml", ".yml"))

    @property
    def profile_path(self) -> Path:
        """Return the file of the profile."""
        return Path(self.profile) if self.names_file else self.shipped / f"{self.profile}.yaml"

    def located(self, folder: Path) -> Self:
        """Return the settings with absolute paths. Raises InputError where there is no profile."""
        settings = super().located(folder)
        if self.names_file:
            path = (folder / self.profile).resolve()
            if not is_file(path):
                raise InputError(f"{path}: file not found, expected a profile", ("link", "profile"))
            return settings.model_copy(update={"profile": str(path)})
        if not self.profile_path.is_file():
            shipped = ", ".join(sorted(path.stem for path in self.shipped.glob("*.yaml")))
            raise InputError(
                f"found {self.profile!r}, expected one of {shipped}, or a path ending in .yaml",
                ("link", "profile"),
            )
        return settings

    def paths(self) -> Iterator[tuple[tuple[str | int, ...], Path]]:
        """Yield the keys of each path, the profile's among them; see Section.paths."""
        yield from super().paths()
        if self.names_file:
            yield ("profile",), Path(self.profile)
