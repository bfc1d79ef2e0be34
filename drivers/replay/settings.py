"""Settings of a link that replays a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field

from gapbridge.core.errors import LogError
from gapbridge.drivers.link_settings import DriverSettings


class ReplaySettings(DriverSettings):
    """Section ``link`` of a cell that runs on a recording."""

    driver: Literal["replay"] = "replay"
    file: Path = Field(
        description="a recording: one file, or a whole run (its name without -001.mcap)"
    )
    speed: float = Field(1.0, gt=0.0, le=100.0, description="times as fast as it was")

    def located(self, folder: Path) -> Self:
        """Return the settings with the recording's path made whole.

        Raises InputError where there is none.
        """
        from gapbridge.core.log.mcap_reading import files_of

        path = (folder / self.file).resolve()
        try:
            files_of(path)
        except LogError as error:
            raise LogError(str(error), ("link", "file")) from None
        return self.model_copy(update={"file": path})
