"""The settings of one run of the daemon."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from gapbridge.bridge.cell.sections import (
    LimitSettings,
    LinkSettings,
    RecordingSettings,
    SetpointSettings,
)
from gapbridge.bridge.cell.settings.web import MetricsSettings, WebSettings
from gapbridge.core.errors import CellError
from gapbridge.drivers.ft_sensor.settings import AnyFtSensor
from gapbridge.drivers.section import Section
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings


class DaemonSettings(Section):
    """The sections of a cell that the daemon uses, and how its loop process reads the model.

    ``model_source`` is a ``module:function`` that takes the cell's path and returns an object with
    a ``model``; tests replace it.
    """

    cell: Path = Field(description="the cell file, from which the loop process reads the model")
    link: LinkSettings = Field(default_factory=UrRtdeSettings)
    ft_sensor: AnyFtSensor | None = None
    limits: LimitSettings = Field(default_factory=LimitSettings)
    setpoints: SetpointSettings = Field(default_factory=SetpointSettings)
    recording: RecordingSettings = Field(default_factory=RecordingSettings)
    web: WebSettings | None = None
    metrics: MetricsSettings | None = None
    hang_timeout: float = Field(
        1.0, gt=0.0, description="s without a heartbeat after which the loop process is killed"
    )
    backoff: tuple[float, float] = Field((0.2, 5.0), description="s before a restart: first, max")
    model_source: str = "gapbridge.bridge.cell:load_cell"
    uncorrected: bool = Field(
        False, description="arm although the model corrects nothing: calibration of a rigid cell"
    )

    @model_validator(mode="after")
    def _limits_fit_link(self) -> DaemonSettings:
        """Refuse offsets that the link cannot send: the motion would end amid one. CellError."""
        keys = ("offset", "m"), ("offset_rotation", "rad")
        for (key, unit), most in zip(keys, self.link.largest_offset, strict=True):
            found = getattr(self.limits, key)
            if found > most:
                raise CellError(
                    f"found {found:g} {unit}, expected at most {most:g}: the link's registers "
                    "hold no more (write.length_count, write.angle_count of its profile)",
                    ("limits", key),
                )
        return self

    @model_validator(mode="after")
    def _source_fits_link(self) -> DaemonSettings:
        """Refuse a setpoint source where the robot's own program moves the arm: CellError."""
        if not self.link.moves_arm and self.setpoints.source != "target":
            raise CellError(
                f"found {self.setpoints.source!r} with a link that sends offsets only, expected "
                "'target': there the robot's own program moves the arm",
                ("setpoints", "source"),
            )
        if self.setpoints.source == "trajectory" and self.setpoints.file is None:
            raise CellError("found nothing, expected the trajectory's CSV", ("setpoints", "file"))
        return self
