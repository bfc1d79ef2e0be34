"""The keys of a CANopen profile, and what may stand there."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from gapbridge.drivers.canopen.objects import Mode
from gapbridge.drivers.section import Number, Positive, Section

NodeId = Annotated[int, Field(ge=1, le=127, strict=True)]
PdoNumber = Annotated[int, Field(ge=1, le=4, strict=True)]
ObjectName = Annotated[str | int, Field(union_mode="left_to_right")]


class Joint(Section):
    """One drive and the joint that it turns."""

    node: NodeId = Field(description="node id")
    counts_per_turn: Positive = Field(description="position units in one turn before the gear")
    gear: Positive = Field(default=1.0, description="turns before the gear in one of the joint")
    direction: Literal[-1, 1] = Field(default=1, description="-1: counts fall as the joint rises")
    zero: Number = Field(default=0.0, description="rad that the joint stands at with count 0")
    rated_torque: Positive | None = Field(
        default=None, description="Nm at the joint where Torque actual value is 1000"
    )


class Heartbeat(Section):
    """Who sends heartbeats to whom."""

    drives: Positive = Field(default=0.1, description="s between two heartbeats of a drive")
    lost_after: Positive = Field(default=0.3, description="s without one: the drive is lost")
    ours: Positive = Field(default=0.05, description="s between two heartbeats of ours")
    drives_wait: float = Field(
        default=0.25, ge=0.0, le=60.0, allow_inf_nan=False,
        description="s without ours after which an armed drive stops by itself; 0: it cannot",
    )  # fmt: skip
    our_node: NodeId = Field(default=127, description="our own node id")


class ProfileFile(Section):
    """The whole file."""

    name: str = Field(min_length=1, description="the arm")
    eds: str = Field(min_length=1, description="the drives' EDS or DCF, relative to this file")
    mode: Mode = Field(description="cyclic synchronous position, or interpolated position")
    sync_period: Positive = Field(default=0.01, description="s, the shortest between two SYNCs")
    sync_window: Positive | None = Field(
        default=None, description="s after a SYNC in which its TPDOs come; left out: 0.7 periods"
    )
    pdo_setup: Literal["write", "check"] = Field(
        default="write", description="check: the drives' PDOs are fixed and must be these"
    )
    confirms_mode: bool = Field(
        default=True, strict=True, description="Statusword bit 12: setpoints are followed"
    )
    velocity_scale: Positive | None = Field(
        default=None,
        description="position units/s in one Velocity actual value; left out: from positions",
    )
    heartbeat: Heartbeat = Heartbeat()
    tpdo: dict[PdoNumber, list[ObjectName]] = Field(
        min_length=1, description="TPDO number: its objects, in order"
    )
    rpdo: dict[PdoNumber, list[ObjectName]] = Field(
        min_length=1, description="RPDO number: its objects, in order"
    )
    joints: list[Joint] = Field(min_length=1, max_length=16, description="from base to flange")
