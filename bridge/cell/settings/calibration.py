"""Section ``calibration`` of the cell file: instrument, loads, poses and workspace."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from gapbridge.bridge.cell.settings.instruments import InstrumentSettings, TypedSettings
from gapbridge.drivers.section import Section

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
NotNegative = Annotated[Number, Field(ge=0)]
Positive = Annotated[Number, Field(gt=0)]
Vector3 = Annotated[list[Number], Field(min_length=3, max_length=3)]
FEWEST_HELD_OUT = 8  # held-out poses from which an accuracy can be judged


class LoadEntry(Section):
    """A load mounted on the flange, the mass of the tool included."""

    name: str = Field(default="", description="name shown to the operator")
    mass: NotNegative = Field(description="kg")
    cog: Vector3 = Field(default=[0.0, 0.0, 0.0], description="m, in the flange frame")


class BoxEntry(Section):
    """A keep-out box for the arm, edges along base axes."""

    lower: Vector3 = Field(description="m, in base")
    upper: Vector3 = Field(description="m, in base")


class JointRange(Section):
    """Narrower joint limits for the session."""

    lower: list[Number] = Field(description="rad, one value per joint")
    upper: list[Number] = Field(description="rad, one value per joint")


class RangeEntry(Section):
    """The measuring range of the instrument."""

    nearest: NotNegative = Field(default=0.0, description="m")
    farthest: Positive | None = Field(default=None, description="m; default: no limit")


class ReflectorEntry(Section):
    """The viewing direction of the reflector on the tool, and its acceptance angle."""

    looks: Vector3 = Field(description="direction in the tool's axes")
    acceptance: Annotated[Number, Field(gt=0, le=3.1416)] = Field(
        description="rad, half angle of the cone in which it is seen"
    )


class CalibrationSettings(Section):
    """Section ``calibration``."""

    instrument: InstrumentSettings = Field(
        default=TypedSettings(unit="mm"), description="kind, unit, ... of the instrument"
    )
    loads: list[LoadEntry] = Field(
        default=[], description="lightest first; default: the cell's payload alone"
    )
    poses: int = Field(default=30, ge=6, le=1000, strict=True, description="poses to fit")
    held_out: int = Field(
        default=8,
        ge=FEWEST_HELD_OUT,
        le=200,
        strict=True,
        description="poses to verify, never fitted",
    )
    repeats: int = Field(
        default=4, ge=0, le=50, strict=True, description="poses repeated, for the repeatability"
    )
    effects: list[str] | None = Field(
        default=None, description="effects of the catalogue to identify"
    )
    instrument_at: Vector3 | None = Field(
        default=None, description="m, in base, approximate: poses out of its sight are left out"
    )
    further_places: list[Vector3] = Field(
        default=[], description="m, in base, approximate: further stations, in turn"
    )
    instrument_range: RangeEntry | None = Field(
        default=None, description="m: poses outside are left out"
    )
    reflector: ReflectorEntry | None = Field(
        default=None, description="poses that turn it away from the instrument are left out"
    )
    keep_out: list[BoxEntry] = Field(default=[], description="boxes that the arm must not enter")
    floor: Number | None = Field(default=0.0, description="m, in base: lowest z of arm and load")
    joint_range: JointRange | None = Field(default=None, description="narrower joint limits")
    joints: Literal["link", "typed", "planned"] | None = Field(
        default=None,
        description="where joint angles come from; default: link if there is one, else typed",
    )
    speed: Annotated[Number, Field(gt=0, le=2.0)] = Field(
        default=0.4, description="rad/s of the fastest joint, with --move"
    )
    settle: Annotated[Number, Field(ge=0, le=60.0)] = Field(
        default=0.5, description="s at rest before the instrument is read"
    )
    samples: int = Field(
        default=10, ge=1, le=10000, strict=True, description="readings averaged at a pose"
    )
    minutes_per_load: NotNegative = Field(default=5.0, description="min to change the load")
    folder: Path = Field(default=Path("calibration"), description="of the sessions")
    accuracy: Positive | None = Field(
        default=None, description="m, required: bound of the error of every held-out pose"
    )
    customer: str = Field(default="", description="for whom, for the report")
    operator: str = Field(default="", description="who measures, for the report")
    serial: str = Field(default="", description="of the arm, for the report")
    environment: str = Field(default="", description="temperature, place, ..., for the report")
