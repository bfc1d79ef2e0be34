"""The schema of a register map."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gapbridge.drivers.modbus.registers import (
    LAST_ADDRESS,
    UNITS,
    Coding,
    Table,
    TypeName,
    WordOrder,
)
from gapbridge.drivers.robot_modes import StopReason
from gapbridge.drivers.section import Number, Positive, Section

FLOAT_COUNT = 1e-6  # of one unit: about what a float's registers still distinguish of an angle
Address = Annotated[int, Field(ge=0, le=LAST_ADDRESS, strict=True)]


class Place(Section):
    """The address and type of numbers."""

    table: Table = Field(description="coil, discrete, holding or input")
    address: Address = Field(description="of the first register, counted from 0")
    type: TypeName = Field(default="u16", description="i16, u16, i32, f32, sm16, ...")
    word_order: WordOrder = "high_first"

    @property
    def coding(self) -> Coding:
        """Return the coding of a number."""
        return Coding(self.type, self.word_order)


class Turns(Section):
    """Revolution counters for angles that wrap at each turn."""

    address: Address
    type: TypeName = "i16"
    word_order: WordOrder = "high_first"
    stride: int | None = Field(default=None, ge=1, description="registers from one to the next")


class Vector(Place):
    """One number per joint (six for a wrench), adjacent or ``stride`` registers apart."""

    scale: Number = Field(default=1.0, description="units per count, not zero")
    unit: str = Field(description="rad, mrad, deg, turn, rad/s, degC, N, ...")
    stride: int | None = Field(default=None, ge=1, description="registers from one to the next")
    turns: Turns | None = Field(default=None, description="revolutions beside the angle")

    @property
    def resolution(self) -> float:
        """Return the SI units in one count; of a float the smallest difference that it holds."""
        count = self.scale * UNITS[self.unit][1]
        return count * FLOAT_COUNT if self.type.startswith("f") else count


class State(Section):
    """What the controller reports in each sample."""

    position: Vector = Field(description="the joint angles")
    velocity: Vector | None = None
    target: Vector | None = Field(default=None, description="the controller's own joint command")
    joint_torque: Vector | None = None
    temperature: Vector | None = None
    force: Vector | None = Field(
        default=None, description="three forces, surroundings on the tool, base axes"
    )
    moment: Vector | None = Field(default=None, description="three moments at the TCP, base axes")


class Clock(Place):
    """A register that changes with every new sample of the controller."""

    kind: Literal["timestamp", "counter", "heartbeat"]
    scale: Positive = Field(default=1.0, description="units per count")
    unit: str = Field(default="s", description="timestamp: s, ms, us; counter: samples")
    again: Address | None = Field(
        default=None, description="where the controller repeats it after the sample: torn if unlike"
    )


class Condition(Place):
    """A condition on the value of a register."""

    name: str = Field(min_length=1, description="what messages call it")
    good: list[int] = Field(min_length=1, description="counts that are fine")
    mask: int | None = Field(default=None, ge=1, description="bits that count")
    otherwise: StopReason = StopReason.NOT_READY

    def fine(self, count: int) -> bool:
        """Return whether the condition is met."""
        return (count if self.mask is None else count & self.mask) in self.good


class RegisterWrite(Place):
    """A number to be written."""

    value: Number = Field(description="counts")


class Mailbox(Section):
    """Offsets in general registers, applied by a program on the robot (docs/porting.md)."""

    mode: Literal["mailbox"]
    table: Literal["holding"] = "holding"
    address: Address = Field(description="of the first of 11 registers")
    echo_table: Literal["holding", "input"] = "holding"
    echo_address: Address = Field(description="of the first of 8 registers of the robot's answer")
    length_count: Positive = Field(default=1.0e-6, description="m per count")
    angle_count: Positive = Field(default=1.0e-6, description="rad per count")
    echo: Positive = Field(default=0.5, description="s in which the robot must answer")
    watchdog: Positive = Field(
        default=0.5, description="s without heartbeat after which the robot takes offsets out"
    )


class TargetTrigger(Section):
    """Joint targets, and a bit or a register that starts the motion."""

    mode: Literal["target_trigger"]
    target: Vector = Field(description="the joint targets")
    single: bool = Field(default=False, strict=True, description="only function 6: one at a time")
    before: list[RegisterWrite] = Field(
        default=[], description="written once when arming: speed, ..."
    )
    trigger: list[RegisterWrite] = Field(
        min_length=1, description="written in turn to start the motion"
    )
    stop: list[RegisterWrite] = Field(default=[], description="written to stop the motion")
    busy: Condition | None = Field(default=None, description="no new target until it is fine")
    result: Condition | None = Field(default=None, description="what the last motion came to")
    following: Positive = Field(default=5.0, description="s in which a target must be reached")


class ReadOnly(Section):
    """Nothing is ever written."""

    mode: Literal["read_only"]
    because: str = Field(default="the register map has no way to write", min_length=1)


Write = Annotated[Mailbox | TargetTrigger | ReadOnly, Field(discriminator="mode")]


class ProfileFile(Section):
    """The whole file."""

    name: str = Field(min_length=1, description="the controller")
    joints: int = Field(ge=1, le=12, description="how many joints it reports")
    port: int = Field(default=502, gt=0, lt=65536)
    device_id: int = Field(default=1, ge=0, le=255)
    period: Positive = Field(default=0.01, description="s, how often registers are renewed")
    gaps: bool = Field(
        default=True, strict=True, description="false: undefined registers cannot be read across"
    )
    function_23: bool = Field(default=False, strict=True, description="reads and writes at once")
    fastest: Positive = Field(default=10.0, description="rad/s that no joint can pass")
    identity: list[Condition] = Field(default=[], description="read once when connecting")
    state: State = Field(description="position, velocity, ...")
    clock: Clock | None = Field(default=None, description="left out: samples have no age of theirs")
    status: list[Condition] = Field(default=[])
    write: Write = Field(description="mode: mailbox, target_trigger or read_only")
