"""The keys of the cell file, with their types, units and bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, ValidationInfo, field_validator

from gapbridge.bridge.cell.sections import (
    LimitSettings,
    LinkSettings,
    RecordingSettings,
    SetpointSettings,
)
from gapbridge.bridge.cell.settings.calibration import (
    CalibrationSettings,
    NotNegative,
    Number,
    Positive,
    Vector3,
)
from gapbridge.bridge.cell.settings.web import MetricsSettings, WebSettings
from gapbridge.drivers.ft_sensor.settings import AnyFtSensor
from gapbridge.drivers.section import Section


class DhRow(Section):
    """One standard DH row."""

    a: Number = Field(description="m")
    alpha: Number = Field(description="rad")
    d: Number = Field(description="m")
    offset: Number = Field(default=0.0, description="rad")
    mass: NotNegative = Field(default=0.0, description="kg")
    cog: Vector3 = Field(default=[0.0, 0.0, 0.0], description="m, in the row's frame")


class Calibration(Section):
    """A UR arm's factory calibration: deltas added to its DH rows."""

    delta_theta: list[Number] | None = Field(default=None, description="rad per joint")
    delta_a: list[Number] | None = Field(default=None, description="m per joint")
    delta_d: list[Number] | None = Field(default=None, description="m per joint")
    delta_alpha: list[Number] | None = Field(default=None, description="rad per joint")


class Robot(Section):
    """The arm: a built-in one, a URDF or DH rows."""

    model: str | None = Field(default=None, description="a built-in arm")
    urdf: Path | None = Field(default=None, description="a file, relative to the cell's folder")
    dh: list[DhRow] | None = Field(default=None, description="standard DH rows")
    tip: str | None = Field(default=None, description="the URDF link that is the flange")
    rated_payload: Positive | None = Field(
        default=None, description="kg, for urdf and dh; known for model"
    )
    calibration: Calibration | Path | None = Field(
        default=None, description="UR's delta_* values, or its calibration.conf"
    )


class Frame(Section):
    """The pose of a frame in its parent frame."""

    xyz: Vector3 = Field(default=[0.0, 0.0, 0.0], description="m")
    rpy: Vector3 = Field(default=[0.0, 0.0, 0.0], description="rad, roll pitch yaw as in URDF")


class Tool(Section):
    """What is mounted on the flange."""

    tcp: Frame = Field(default=Frame(), description="TCP in the flange frame")


class Payload(Section):
    """The load on the flange, the mass of the tool included."""

    mass: NotNegative = Field(default=0.0, description="kg")
    cog: Vector3 = Field(default=[0.0, 0.0, 0.0], description="m, in the flange frame")


class Compliance(Section):
    """Joint flexibilities, one value per joint."""

    axial: list[NotNegative] | None = Field(default=None, description="rad/Nm about the axis")
    radial: list[NotNegative] | None = Field(default=None, description="rad/Nm across the axis")


class EffectEntry(Section):
    """A further effect in the model, as ``--apply`` writes it."""

    effect: str = Field(description="an effect of the catalogue")
    joint: int | None = Field(default=None, strict=True, description="from 1")
    order: Number | None = Field(
        default=None, gt=0.0, le=1.0e5, description="cycles per turn of the joint"
    )
    parameters: dict[str, Number] = Field(default={}, description="name: value")
    stand_in: bool = Field(default=False, strict=True, description="effective, not proved")


class MetrologyEntry(Section):
    """The instrument that measured the TCP."""

    registered: bool = Field(default=False, strict=True, description="its frame is base")
    sigma: NotNegative = Field(default=2.0e-5, description="m, 1 sigma of one coordinate")
    repeatability: NotNegative | None = Field(default=None, description="m, of the arm, 1 sigma")


class Simulation(Section):
    """The plant of ``simulate`` and the bench, drawn from the seed."""

    seed: int = Field(default=0, ge=0, strict=True, description="of the plant and all noise")
    host: str | None = Field(default=None, description="loopback address; default: link.host")
    start_q: list[Number] | None = Field(default=None, description="rad, initial joint angles")
    payload: Payload | None = Field(
        default=None, description="true load on the flange; default: payload"
    )
    compliance: Compliance | None = Field(
        default=None, description="true flexibilities, rad/Nm; default: drawn from the seed"
    )
    droop: list[NotNegative] | None = Field(
        default=None, description="rad/Nm per joint, compliance of the servos; default: none"
    )
    zero: list[Number] | None = Field(
        default=None, description="rad per joint, true angle - encoder; default: none"
    )
    tool_shift: Vector3 | None = Field(
        default=None, description="m, flange axes: true TCP - tool.tcp; default: 0"
    )
    tracker_noise: NotNegative | None = Field(default=None, description="m, 1 sigma")
    rtde_port: int | None = Field(default=None, gt=0, lt=65536, strict=True)
    dashboard_port: int | None = Field(default=None, gt=0, lt=65536, strict=True)
    script_port: int | None = Field(default=None, gt=0, lt=65536, strict=True)
    bench_port: int | None = Field(default=None, gt=0, lt=65536, strict=True)
    primary_port: int | None = Field(default=None, gt=0, lt=65536, strict=True)


class SourceFile(Section):
    """An input file of a result."""

    role: str = Field(description="log, cell or sim")
    name: str = Field(description="without its folder")
    sha256: str | None = Field(default=None, description="of its bytes")


class CauseParameter(Section):
    """A parameter of a cause, as the diagnosis estimated it."""

    name: str
    value: Number | str | None = Field(
        default=None, description="of a session its name; null: no time, because clocks overlap"
    )
    std: NotNegative | None = Field(default=None, description="1 sigma")
    unit: str = ""


class CauseEntry(Section):
    """A cause that the diagnosis named, and the effects indistinguishable from it."""

    effect: str
    joints: list[int] = Field(default=[])
    channel: str = ""
    parameters: list[CauseParameter] = Field(default=[])
    indistinguishable_from: list[str] = Field(default=[])


class Provenance(Section):
    """Origin of the model in this cell, as fit, calibrate and --apply write it."""

    version: str = Field(default="", description="of Gapbridge")
    time: str = Field(default="", description="when it was written, UTC")
    command: str = Field(default="", description="that wrote it")
    arguments: dict[str, Any] = Field(default={}, description="of the command")
    files: list[SourceFile] = Field(default=[])
    fitted: dict[str, tuple[Number, Number]] = Field(
        default={}, description="minimum and maximum of each log column in the data of the fit"
    )
    intervals: dict[str, tuple[Number, Number]] = Field(
        default={}, description="95 % interval of each fitted or applied parameter, SI"
    )
    parameters: list[str] = Field(default=[], description="names of the fitted parameters")
    covariance: list[list[Number]] = Field(
        default=[],
        validate_default=True,
        description="of those parameters, SI: a row and a column each",
    )
    causes: list[CauseEntry] = Field(default=[], description="named by a diagnosis, with its ties")

    @field_validator("covariance")
    @classmethod
    def _is_covariance(cls, rows: list[list[float]], info: ValidationInfo) -> list[list[float]]:
        size = len(info.data.get("parameters", rows))
        if [len(row) for row in rows] != [size] * size:
            raise ValueError(f"expected {size} rows of {size} numbers, one for each of parameters")
        for i, row in enumerate(rows):
            if row[i] < 0.0:
                raise ValueError(f"expected variances of 0 or more: that of entry {i + 1} is less")
        return rows


class CellFile(Section):
    """The whole file."""

    robot: Robot = Field(description="model, urdf or dh")
    tool: Tool = Tool()
    payload: Payload = Payload()
    gravity: Vector3 = Field(default=[0.0, 0.0, -9.80665], description="m/s2, in base")
    reference_temperature: Number = Field(default=25.0, description="°C")
    compliance: Compliance = Compliance()
    effects: list[EffectEntry] = Field(default=[])
    metrology: MetrologyEntry = MetrologyEntry()
    link: LinkSettings | None = Field(default=None, description="driver, host, ...")
    ft_sensor: AnyFtSensor | None = Field(
        default=None, description="driver, sensor_in_flange, ...: a separately connected sensor"
    )
    limits: LimitSettings = LimitSettings()
    setpoints: SetpointSettings = SetpointSettings()
    recording: RecordingSettings = RecordingSettings()
    web: WebSettings | None = Field(default=None, description="port, ...: the status page")
    metrics: MetricsSettings | None = Field(default=None, description="port, ...: for Prometheus")
    calibration: CalibrationSettings = Field(
        default=CalibrationSettings(), description="instrument, loads, ...: of calibration sessions"
    )
    simulation: Simulation = Simulation()
    provenance: Provenance | None = Field(
        default=None, description="origin of the model; written by the commands"
    )
