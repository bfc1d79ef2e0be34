"""The schema of a profile."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from gapbridge.drivers.robot_modes import StopReason
from gapbridge.drivers.section import Number, Section

Identifier = Annotated[int, Field(ge=0, le=0x1FFFFFFF)]


class Quantity(Section):
    """One signal per joint, in the joints' order, each ``MESSAGE.SIGNAL`` of the DBC."""

    signals: list[str] = Field(min_length=1)
    unit: str | None = Field(default=None, description="left out: the DBC's own")


class Feedback(Section):
    """What the arm reports about its joints."""

    position: Quantity
    velocity: Quantity | None = Field(default=None, description="left out: from positions")
    torque: Quantity | None = None
    temperature: Quantity | None = None


class SampleEntry(Section):
    """Which messages make one complete sample."""

    messages: list[str] = Field(min_length=1)
    window: Number = Field(gt=0.0, le=0.5, description="s from the first to the last of them")
    ordered: bool = Field(default=False, description="they always come in the order given")
    counter: str | None = Field(
        default=None, description="a signal in each of them that counts samples"
    )


class StatusEntry(Section):
    """A signal that reports whether the arm may be used."""

    signal: str
    normal: list[int] = Field(min_length=1, description="values of an arm that is well")
    values: dict[int, StopReason] = Field(default={}, description="what single other values mean")
    otherwise: StopReason = Field(
        default=StopReason.FAULT, description="what every other value means"
    )
    while_writing: bool = Field(default=False, description="counts only while we write")


class EnabledEntry(Section):
    """The signals that report whether the motors are enabled, and the values that say yes."""

    signals: list[str] = Field(min_length=1)
    values: list[int] = Field(default=[1], min_length=1)


class FrameEntry(Section):
    """One frame: a message of the DBC with its signals' values, or with its bytes."""

    message: str
    signals: dict[str, Number] = Field(default={})
    data: str | None = Field(default=None, description="bytes, hexadecimal")

    @model_validator(mode="after")
    def _one_of_both(self) -> FrameEntry:
        """Refuse signals together with bytes."""
        if self.data is not None and self.signals:
            raise ValueError("expected data or signals, not both")
        return self


class Step(Section):
    """One step of a sequence: frames, a hold at the present joints, a wait."""

    send: list[FrameEntry] = Field(default=[])
    hold: bool = Field(default=False, description="send the present joints as setpoint")
    wait: Number = Field(default=0.0, ge=0.0, le=5.0, description="s, after the frames")
    until: Literal["enabled", "disabled", "ready"] | None = Field(
        default=None, description="repeat until the motors, or every status (ready), say so"
    )
    within: Number = Field(default=2.0, gt=0.0, le=30.0, description="s that `until` may take")
    every: Number = Field(default=0.1, gt=0.0, le=5.0, description="s between repetitions")


class SetpointEntry(Section):
    """How a joint setpoint is sent to the arm."""

    position: Quantity
    frames: list[FrameEntry] = Field(min_length=1, description="in the order they are sent")


class ProfileFile(Section):
    """The whole file."""

    name: str
    source: str | list[str] = Field(default="", description="where the map is published")
    dbc: str = Field(description="a file beside this one")
    joints: int = Field(ge=1, le=16)
    rate: Number = Field(gt=0.0, le=2000.0, description="samples per second that the arm sends")
    direction: list[Literal[1, -1]] | None = Field(default=None, description="sign per joint")
    zero: list[Number] | None = Field(default=None, description="rad at the wire's zero, per joint")
    gear: list[Number] | Number = Field(default=1.0, description="wire turns per joint turn")
    feedback: Feedback
    sample: SampleEntry
    status: list[StatusEntry] = Field(default=[])
    status_timeout: Number = Field(default=1.0, gt=0.0, le=60.0, description="s")
    enabled: EnabledEntry | None = None
    request: list[FrameEntry] = Field(
        default=[], description="asked each cycle of an arm that speaks only when spoken to"
    )
    setpoint: SetpointEntry | None = Field(default=None, description="left out: read only")
    enable: list[Step] = Field(default=[])
    release: list[Step] = Field(default=[])
    stop: list[Step] = Field(default=[])
    sends: list[Identifier] = Field(default=[], description="the only identifiers we may send")
    control: list[Identifier] = Field(
        default=[], description="further identifiers that only a commander sends"
    )
