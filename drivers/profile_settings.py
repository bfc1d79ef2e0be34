"""What links say whose controller is described by a file: a shipped profile, or one's own."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar, Self

from pydantic import Field

from gapbridge.core.errors import InputError
from gapbridge.drivers.link_settings import DriverSettings


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
        """Return the settings with the profile's path resolved; see DriverSettings."""
        if self.names_file:
            return self.model_copy(update={"profile": str((folder / self.profile).resolve())})
        if not self.profile_path.is_file():
            shipped = ", ".join(sorted(path.stem for path in self.shipped.glob("*.yaml")))
            raise InputError(
                f"link.profile: found {self.profile!r}, expected one of {shipped}, or a path "
                "ending in .yaml"
            )
        return self
