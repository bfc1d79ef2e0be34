"""What one run of the daemon is made of."""

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
from gapbridge.drivers.ft_sensor.settings import AnyFtSensor
from gapbridge.drivers.section import Section
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings


class DaemonSettings(Section):
    """One run: a cell's sections, and the path by which the loop's process reads the model.

    ``model_source`` names the function that reads it, ``module:function`` from a path to an object
    with a ``model``; tests replace it.
    """

    cell: Path = Field(description="the cell file; the loop's process takes its model from there")
    link: LinkSettings = Field(default_factory=UrRtdeSettings)
    ft_sensor: AnyFtSensor | None = None
    limits: LimitSettings = Field(default_factory=LimitSettings)
    setpoints: SetpointSettings = Field(default_factory=SetpointSettings)
    recording: RecordingSettings = Field(default_factory=RecordingSettings)
    web: WebSettings | None = None
    metrics: MetricsSettings | None = None
    hang_timeout: float = Field(
        1.0, gt=0.0, description="s without a heartbeat after which the loop's process is ended"
    )
    backoff: tuple[float, float] = Field((0.2, 5.0), description="s before a restart: first, most")
    model_source: str = "gapbridge.bridge.cell:load_cell"
    uncorrected: bool = Field(
        False, description="arm though the model corrects nothing: a calibration moves a rigid cell"
    )

    @model_validator(mode="after")
    def _source_fits_link(self) -> DaemonSettings:
        """Refuse a source of motion where the motion is the robot's own."""
        if not self.link.moves_arm and self.setpoints.source != "target":
            raise ValueError(
                f"setpoints.source: found {self.setpoints.source!r} with a link that sends "
                "offsets only, expected 'target': there the robot's own program moves the arm"
            )
        if self.setpoints.source == "trajectory" and self.setpoints.file is None:
            raise ValueError("setpoints.file: found nothing, expected the trajectory's CSV")
        return self
