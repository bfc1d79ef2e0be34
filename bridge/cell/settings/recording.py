"""Section ``recording`` of the cell file."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field

from gapbridge.drivers.section import Section


class RecordingSettings(Section):
    """Section ``recording``: folder, rate and size of recordings."""

    folder: Path | None = Field(
        Path("recordings"), description="the files of each run go here (MCAP); null: record nothing"
    )
    every: int = Field(1, ge=1, description="record one of this many cycles")
    segment_size: float = Field(
        256.0, gt=0.0, le=4096.0, description="MB after which a run continues in a new file"
    )
    segment_time: float = Field(
        3600.0, ge=1.0, description="s after which a run continues in a new file"
    )
    keep_total: float | None = Field(
        None, gt=0.0,
        description="MB of recordings kept in the folder; oldest files are deleted; null: all kept",
    )  # fmt: skip
    keep_free: float = Field(
        200.0, ge=0.0, description="MB left free on the disk: with less, recording pauses"
    )
