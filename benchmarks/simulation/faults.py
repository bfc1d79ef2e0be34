"""What goes wrong in a run: every family, drawn by the seed; some for a moment, some for good."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from benchmarks.simulation import canopen, sensor
from benchmarks.simulation import process_faults as process
from benchmarks.simulation import robot_faults as robot
from benchmarks.simulation import wire_faults as wire
from benchmarks.simulation.processes import Run

Draw = random.Random


@dataclass(frozen=True)
class Fault:
    """One family: ``make`` does it, and returns in words what it did."""

    name: str
    make: Callable[[Run, Draw], str]
    links: tuple[str, ...] = (
        "ur_servoj", "ur_offset", "modbus", "can", "canopen", "ur_sensor", "odrive", "openarm",
        "modbus_target",
    )  # fmt: skip
    weight: float = 1.0


def _of_link(make: Callable[[Any, Draw], str]) -> Callable[[Run, Draw], str]:
    return lambda run, draw: make(run.link, draw)


_SERVOJ = ("ur_servoj", "ur_sensor")
_UR = (*_SERVOJ, "ur_offset")
_CAN = ("can", "odrive", "openarm")
_BUS = (*_CAN, "canopen")
_MODBUS = ("modbus", "modbus_target")
FAULTS = (
    Fault("delay step", wire.delay_step, weight=2.0),
    Fault("jitter", wire.jitter),
    Fault("held back", wire.hold_back, weight=2.0),
    Fault("lost messages", wire.lose, (*_MODBUS, *_BUS)),
    Fault("doubled messages", wire.double, (*_UR, *_BUS)),
    Fault("corruption", wire.spoil, weight=2.0),
    Fault("reordering", wire.reorder, _BUS),
    Fault("connection cut", wire.cut),
    Fault("controller restart", robot.restart),
    Fault("controller's clock stands", robot.freeze_clock, (*_UR, "modbus")),
    Fault("values stand", robot.freeze_values, (*_UR, *_BUS)),
    Fault("drift of the controller's clock", robot.pace, _UR),
    Fault("jump of the controller's clock", robot.jump, _UR),
    Fault("protective stop", robot.protective_stop),
    Fault("emergency stop", robot.emergency_stop),
    Fault("stop for a moment", robot.brief_stop),
    Fault("payload declared", robot.payload, _UR),
    Fault("TCP declared", robot.tcp, _UR),
    Fault("speed slider", robot.speed, _UR),
    Fault("robot's program ends", robot.end_program, (*_UR, "modbus")),
    Fault("another commander", robot.foreign),
    Fault("writes refused", robot.refuse, (*_SERVOJ, *_BUS)),
    Fault("frame withheld", wire.withhold, _CAN),
    Fault("model no number", process.spoil_model),
    Fault("loop stalls", process.stall, weight=3.0),
    Fault("loop dies", process.die, weight=2.0),
    Fault("daemon stalls", process.stall_daemon),
    Fault("machine stalls", process.stall_machine),
    Fault("planner silent", process.silence_planner, (*_SERVOJ, *_BUS, "modbus_target")),
    Fault("planner's nonsense", process.plan_nonsense, (*_SERVOJ, *_BUS, "modbus_target")),
    Fault("arm", process.arm, weight=2.0),
    Fault("disarm", process.disarm, weight=2.0),
    Fault("stop", process.stop, weight=0.3),
    *(Fault(name, _of_link(make), ("canopen",)) for name, make in canopen.FAMILIES),
    *(Fault(name, _of_link(make), ("ur_sensor",)) for name, make in sensor.FAMILIES),
)
LATER = (
    Fault("wrong requests", wire.spoil_requests, ("ur_offset", "modbus")),
    Fault("flood of frames", wire.flood, _BUS),
    Fault("error frames", wire.error_frames, _BUS),
    Fault("drift of the controller's cycle", robot.pace_of_cycles, (*_MODBUS, *_BUS)),
    Fault("mode", robot.mode, weight=2.0),
    Fault("robot's program paused", robot.pause_program, (*_UR, "modbus")),
    Fault("remote control off", robot.local_mode, _SERVOJ),
    Fault("calendar set", process.set_calendar),
    Fault("daemon dies", process.die_daemon, weight=2.0),
    Fault("daemon started anew", process.restart_daemon),
    Fault("disk full", process.fill_disk),
    Fault("recorder dies", process.kill_recorder),
    # where joints are written, the arm must be moved first, see docs/daemon.md
    Fault("power cut", process.cut_power, ("ur_offset", "modbus")),
    Fault("cell file read again", process.reload, weight=2.0),
)
"""Families that were added later: see ``drawn``."""
SLOW = (Fault("delay that grows", wire.grow, (*_UR, *_MODBUS)),)
"""Families that take longer than a drawn run: in plans only."""
ALL = (*FAULTS, *LATER)
SHARE = 0.4  # of faults that are of LATER


def drawn(draw: Draw, later: Draw | None, link: str, count: int) -> list[Fault]:
    """Return so many faults for a link, in the order in which they happen.

    ``later`` draws those of LATER, so that without it a seed is the run that it was before them.
    """
    found = _of(FAULTS, link, draw, count)
    if later is None:
        return found
    return [_of(LATER, link, later, 1)[0] if later.random() < SHARE else f for f in found]


def _of(table: tuple[Fault, ...], link: str, draw: Draw, count: int) -> list[Fault]:
    able = [fault for fault in table if link in fault.links]
    return draw.choices(able, [fault.weight for fault in able], k=count)
