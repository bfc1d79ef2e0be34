"""Section ``calibration.instrument``: kind, unit and connection of the instrument.

These pydantic models import no instrument library: a cell can be read without one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from gapbridge.drivers.section import Host, Number, Positive, Section

LengthUnit = Literal["m", "mm", "um", "in"]
AngleUnit = Literal["rad", "deg"]
METRES: dict[str, float] = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
RADIANS: dict[str, float] = {"rad": 1.0, "deg": 0.017453292519943295}


class Base(Section):
    """The settings that all instruments share."""

    reads: ClassVar[str] = "position"  # kind of its readings if it measures no pose
    sigma: Annotated[Positive, Field(lt=0.01)] | None = Field(  # in mm it would pass everything
        default=None, description="m, 1 sigma of one coordinate; default: metrology.sigma"
    )
    serial: str = Field(default="", description="of the instrument, for the report")
    certificate: str = Field(
        default="", description="number and date of its own calibration, for the report"
    )

    @property
    def measures(self) -> str:
        """Return the kind of its readings, a key of the calibration's observables."""
        return self.reads

    @property
    def options(self) -> dict[str, Any]:
        """Return the further arguments of its observable."""
        return {}


class Coordinates(Base):
    """An instrument whose readings are points or poses, as numbers in text."""

    unit: LengthUnit = Field(description="of lengths: m, mm, um or in")
    pose: bool = Field(default=False, strict=True, description="true: rotation as well")
    rotation: Literal["rotation_vector", "rpy", "quaternion"] = Field(
        default="rotation_vector", description="representation of the rotation; quaternion: x y z w"
    )
    angle_unit: AngleUnit = Field(default="deg", description="of rotation angles: rad or deg")

    @property
    def measures(self) -> str:
        """Return ``pose`` or ``position``."""
        return "pose" if self.pose else "position"

    @property
    def units(self) -> tuple[str, ...]:
        """Return the units that its numbers have: of lengths, then of angles if it reads any."""
        angles = self.pose and self.rotation != "quaternion"
        return (self.unit, self.angle_unit) if angles else (self.unit,)

    @property
    def width(self) -> int:
        """Return the count of numbers in a reading."""
        if not self.pose:
            return 3
        return 7 if self.rotation == "quaternion" else 6


class TypedSettings(Coordinates):
    """Numbers that are typed, or pasted from the clipboard, at the terminal."""

    kind: Literal["typed"] = "typed"


class ExportSettings(Coordinates):
    """Text files written by the instrument's software."""

    columns: tuple[str, ...] | None = Field(
        default=None, description="names of the columns; default: the last ones of each row"
    )
    timeout: Positive = Field(default=600.0, description="s to wait for the next reading")


class FileSettings(ExportSettings):
    """A CSV file with one reading per row, in the order of the plan."""

    kind: Literal["file"]
    file: Path = Field(description="the CSV, relative to the cell's folder")


class FolderSettings(ExportSettings):
    """A folder into which the tracker's software exports one file per reading."""

    kind: Literal["folder"]
    folder: Path = Field(description="relative to the cell's folder")
    pattern: str = Field(default="*.csv", description="which files count")


class LineFeedSettings(Coordinates):
    """A TCP port of the tracker's software that sends one reading per line."""

    kind: Literal["line_feed"]
    host: Host = Field(default="127.0.0.1", description="address of the tracker's software")
    port: int = Field(gt=0, lt=65536, strict=True, description="of the tracker's software")
    trigger: str = Field(default="", description="line that asks for one reading; none: it streams")
    timeout: Positive = Field(default=10.0, description="s to wait for a line")


class DialGaugeSettings(Base):
    """A dial gauge, draw wire or ballbar: the distance from a fixed point to the target."""

    reads = "distance"
    kind: Literal["dial_gauge"]
    unit: LengthUnit = Field(description="of lengths: m, mm, um or in")
    zero: Number | None = Field(
        default=None, description="distance at which it reads 0, in its unit; default: estimated"
    )

    @property
    def options(self) -> dict[str, Any]:
        """Return whether its zero is unknown."""
        return {"zeroed": self.zero is None}


class TwoBallsSettings(Base):
    """Two balls on the tool, both measured at each pose: their difference is used."""

    reads = "relative"
    kind: Literal["two_balls"]
    unit: LengthUnit = Field(description="of lengths: m, mm, um or in")


class SphereSettings(Base):
    """A fixed sphere that the tool's probe touches: only joint angles are read."""

    reads = "sphere"
    kind: Literal["sphere"]
    radius: Annotated[Positive, Field(lt=1.0)] | None = Field(
        default=None, description="m, of sphere and probe together; default: estimated"
    )

    @property
    def options(self) -> dict[str, Any]:
        """Return the radius."""
        return {"radius": self.radius}


class PointSettings(Base):
    """A fixed point that the tool's tip touches: only joint angles are read."""

    reads = "point"
    kind: Literal["point"]


class SimulatedTrackerSettings(Base):
    """The simulated laser tracker of `gapbridge simulate`."""

    kind: Literal["simulated_tracker"]
    host: Host | None = Field(default=None, description="loopback address; default: link.host")
    port: int = Field(default=30100, gt=0, lt=65536, strict=True, description="the bench port")
    pose: bool = Field(default=False, strict=True, description="true: rotation as well")

    @property
    def measures(self) -> str:
        """Return ``pose`` or ``position``."""
        return "pose" if self.pose else "position"


InstrumentSettings = Annotated[
    TypedSettings
    | FileSettings
    | FolderSettings
    | LineFeedSettings
    | DialGaugeSettings
    | TwoBallsSettings
    | SphereSettings
    | PointSettings
    | SimulatedTrackerSettings,
    Field(discriminator="kind"),
]
"""Section ``calibration.instrument``: the settings of the instrument that ``kind`` names."""
