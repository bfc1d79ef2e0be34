"""What goes wrong in a run: every family, drawn by the seed; some for a moment, some for good."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.simulation import can, canopen, modbus, sensor, ur
from benchmarks.simulation.can import CanLink
from benchmarks.simulation.canopen import CanopenLink
from benchmarks.simulation.modbus import ModbusLink
from benchmarks.simulation.processes import PLANNED_JOINT, Run
from benchmarks.simulation.sensor import SensorLink
from benchmarks.simulation.ur import UrLink
from benchmarks.simulation.wires import WAY

Draw = random.Random
BUSES = (CanLink, CanopenLink)


@dataclass(frozen=True)
class Fault:
    """One family: ``make`` does it, and returns in words what it did."""

    name: str
    make: Callable[[Run, Draw], str]
    links: tuple[str, ...] = (
        "ur_servoj", "ur_offset", "modbus", "can", "canopen", "ur_sensor",
    )  # fmt: skip
    weight: float = 1.0


def _delay(run: Run, draw: Draw) -> str:
    """Have the way be longer for good: what no clock at one end shows."""
    most = 0.3 if not isinstance(run.link, BUSES) else 0.003  # a bus has no such queue
    run.link.down.delay = WAY + draw.uniform(0.0, most) ** 1.5
    if draw.random() < 0.5:
        run.link.up.delay = WAY + draw.uniform(0.0, most) ** 1.5
    return f"down {run.link.down.delay:.4f} s, up {run.link.up.delay:.4f} s"


def _jitter(run: Run, draw: Draw) -> str:
    most = 0.002 if isinstance(run.link, BUSES) else 0.1
    run.link.down.jitter = draw.uniform(0.0, most)
    return f"{run.link.down.jitter:.4f} s"


def _hold(run: Run, draw: Draw) -> str:
    seconds = draw.choice((0.02, 0.05, 0.1, 0.3, 0.8, 4.0)) * draw.uniform(0.5, 1.5)
    wires = draw.choice(([run.link.down], [run.link.up], [run.link.down, run.link.up]))
    if isinstance(run.link, BUSES):
        run.link.controller.stall(seconds)
        return f"arm silent for {seconds:.3f} s"
    for wire in wires:
        wire.hold(seconds)
    return f"{len(wires)} for {seconds:.3f} s"


def _lose(run: Run, draw: Draw) -> str:
    share = draw.choice((0.02, 0.2, 0.6))
    wire = draw.choice((run.link.up, run.link.down))
    wire.lost = share
    return f"{share:g} of messages"


def _double(run: Run, draw: Draw) -> str:
    run.link.down.doubled = draw.choice((0.05, 0.5))
    return f"{run.link.down.doubled:g} of messages"


def _spoil(run: Run, draw: Draw) -> str:
    spoiled: Any = {
        UrLink: ur.spoiled, ModbusLink: modbus.spoiled, CanLink: can.spoiled,
        CanopenLink: canopen.spoiled, SensorLink: ur.spoiled,
    }[type(run.link)]  # fmt: skip
    run.link.down.change = lambda message: spoiled(message, draw)
    run.link.down.changed = draw.choice((1, 1, 2, 3, 10, 40))
    return f"{run.link.down.changed} messages"


def _reorder(run: Run, draw: Draw) -> str:
    run.link.down._ordered = False
    run.link.down.jitter = draw.uniform(0.0, 0.02)
    return f"within {run.link.down.jitter:.4f} s"


def _cut(run: Run, draw: Draw) -> str:
    seconds = draw.choice((0.0, 0.0, 0.2, 1.5))
    run.link.refuses_until = run.world.now + seconds
    run.link.disconnect()
    return f"refused for {seconds:g} s"


def _restart(run: Run, draw: Draw) -> str:
    seconds = draw.uniform(0.05, 1.0)
    run.link.restart(seconds)
    return f"{seconds:.2f} s"


def _freeze_clock(run: Run, draw: Draw) -> str:
    controller, seconds = run.link.controller, draw.choice((0.02, 0.1, 0.5, 2.0))
    controller.frozen = True
    run.world.after(seconds, lambda: setattr(controller, "frozen", False))
    return f"{seconds:g} s"


def _freeze_values(run: Run, draw: Draw) -> str:
    run.link.freezes_values = True
    return "for good"


def _pace(run: Run, draw: Draw) -> str:
    # faster by at most what the gate allows for; slower ones only look older than they are
    run.link.pace = 1.0 + draw.choice((1e-4, 2e-3, 0.02, -1e-4, -2e-3, -0.02, -0.2))
    return f"{run.link.pace:g}"


def _jump(run: Run, draw: Draw) -> str:
    step = draw.choice((-1, 1)) * draw.choice((0.01, 0.05, 0.3, 5.0))
    run.link.controller.clock = max(run.link.controller.clock + step, 0.0)
    return f"{step:g} s"


def _protective(run: Run, draw: Draw) -> str:
    run.link.controller.protective_stop()
    return ""


def _emergency(run: Run, draw: Draw) -> str:
    run.link.controller.emergency_stop()
    return ""


def _brief_stop(run: Run, draw: Draw) -> str:
    controller, seconds = run.link.controller, draw.uniform(0.005, 0.1)
    controller.protective_stop()
    run.world.after(seconds, controller.unlock)
    return f"{seconds:.3f} s"


def _payload(run: Run, draw: Draw) -> str:
    mass = draw.choice((0.0, 2.0, 8.0, 60.0, 900.0, -1.0))
    run.link.declare(mass)
    return f"{mass:g} kg"


def _tcp(run: Run, draw: Draw) -> str:
    shift = draw.choice((0.001, 0.02, 0.2))
    run.link.controller.declared.set_tcp((shift, 0.0, 0.18, 0.0, 0.0, 0.0))
    return f"{shift:g} m"


def _speed(run: Run, draw: Draw) -> str:
    link = run.link
    assert isinstance(link, UrLink)
    link.speed = draw.choice((0.0, 0.3, 0.97, 3.0, float("nan")))
    return f"{link.speed:g}"


def _program(run: Run, draw: Draw) -> str:
    link = run.link
    if isinstance(link, ModbusLink):
        link.program.running = False
    elif isinstance(link, UrLink):
        link.foreign(0.0)
    return ""


def _foreign(run: Run, draw: Draw) -> str:
    seconds = draw.choice((0.0, 0.1, 0.6))
    run.link.foreign(seconds)
    return f"{seconds:g} s"


def _refuse(run: Run, draw: Draw) -> str:
    link = run.link
    if isinstance(link, UrLink):
        link.refuses_servo = True
    elif isinstance(link, BUSES):
        link.refuses_frames = True
        run.world.after(draw.uniform(0.01, 0.3), lambda: setattr(link, "refuses_frames", False))
    return ""


def _of_link(make: Callable[[Any, Draw], str]) -> Callable[[Run, Draw], str]:
    return lambda run, draw: make(run.link, draw)


def _withhold(run: Run, draw: Draw) -> str:
    link = run.link
    assert isinstance(link, CanLink)
    identifier = draw.choice((0x2A5, 0x2A6, 0x2A7, 0x2A1, 0x261))
    link.node.withheld.add(identifier)
    run.world.after(draw.choice((0.01, 0.1, 1.0)), lambda: link.node.withheld.discard(identifier))
    return f"{identifier:#x}"


def _model(run: Run, draw: Draw) -> str:
    loop = run.loops[-1].loop
    if loop is None:
        return "no loop"
    compensator = loop._stream._compensator
    correct, bad = compensator.correct, draw.choice((np.nan, np.inf, 0.5))

    def spoiled(*given: Any) -> Any:
        found = correct(*given)
        return found._replace(q=found.q + bad) if hasattr(found, "_replace") else found

    if draw.random() < 0.5:
        run.world.after(0.05, lambda: setattr(compensator, "correct", correct))
    compensator.correct = spoiled  # type: ignore[method-assign]
    return f"{bad:g}"


def _stall(run: Run, draw: Draw) -> str:
    """Have the loop's process stand still at any of its lines, or between two cycles."""
    seconds, process = draw.choice((0.003, 0.03, 0.06, 0.2, 0.6, 1.5)), run.loops[-1].process
    if draw.random() < 0.3:
        process.freeze(seconds)
        return f"{seconds:g} s, waiting"
    lines = draw.randint(1, 600)
    process.at_line(lines, lambda: process.stand_still(seconds))
    return f"{seconds:g} s, {lines} lines on"


def _death(run: Run, draw: Draw) -> str:
    process = run.loops[-1].process
    if draw.random() < 0.3:
        process.kill()
        return "waiting"
    lines = draw.randint(1, 600)
    process.at_line(lines, process.kill)
    return f"{lines} lines on"


def _daemon_stall(run: Run, draw: Draw) -> str:
    seconds = draw.choice((0.05, 0.3, 1.2))
    run.process.freeze(seconds)
    return f"{seconds:g} s"


def _machine(run: Run, draw: Draw) -> str:
    seconds = draw.choice((0.01, 0.08, 0.5))
    run.process.freeze(seconds)
    run.loops[-1].process.freeze(seconds)
    return f"{seconds:g} s"


def _planner_silent(run: Run, draw: Draw) -> str:
    if run.planner is None:
        return "no planner"
    run.planner.silent_until = run.world.now + draw.choice((0.05, 0.3, 2.0))
    return ""


def _planner_nonsense(run: Run, draw: Draw) -> str:
    if run.planner is None:
        return "no planner"
    step = draw.choice((0.02, 0.3, 1.5, 9.0, float("nan")))

    def nonsense(q: Any) -> Any:
        q[PLANNED_JOINT] += step
        return q

    planner = run.planner
    planner.nonsense = nonsense
    run.world.after(draw.choice((0.03, 0.2)), lambda: setattr(planner, "nonsense", None))
    return f"{step:g} rad"


def _arm(run: Run, draw: Draw) -> str:
    run.daemon.arm("somebody")
    return ""


def _disarm(run: Run, draw: Draw) -> str:
    run.daemon.disarm("somebody")
    return ""


def _stop(run: Run, draw: Draw) -> str:
    run.daemon.stop()
    return ""


_SERVOJ = ("ur_servoj", "ur_sensor")
_UR = (*_SERVOJ, "ur_offset")
FAULTS = (
    Fault("delay step", _delay, weight=2.0),
    Fault("jitter", _jitter),
    Fault("held back", _hold, weight=2.0),
    Fault("lost messages", _lose, ("modbus", "can", "canopen")),
    Fault("doubled messages", _double, (*_UR, "can", "canopen")),
    Fault("corruption", _spoil, weight=2.0),
    Fault("reordering", _reorder, ("can", "canopen")),
    Fault("connection cut", _cut),
    Fault("controller restart", _restart),
    Fault("controller's clock stands", _freeze_clock, (*_UR, "modbus")),
    Fault("values stand", _freeze_values, (*_UR, "can", "canopen")),
    Fault("drift of the controller's clock", _pace, _UR),
    Fault("jump of the controller's clock", _jump, _UR),
    Fault("protective stop", _protective),
    Fault("emergency stop", _emergency),
    Fault("stop for a moment", _brief_stop),
    Fault("payload declared", _payload, _UR),
    Fault("TCP declared", _tcp, _UR),
    Fault("speed slider", _speed, _UR),
    Fault("robot's program ends", _program, (*_UR, "modbus")),
    Fault("another commander", _foreign),
    Fault("writes refused", _refuse, (*_SERVOJ, "can", "canopen")),
    Fault("frame withheld", _withhold, ("can",)),
    Fault("model no number", _model),
    Fault("loop stalls", _stall, weight=3.0),
    Fault("loop dies", _death, weight=2.0),
    Fault("daemon stalls", _daemon_stall),
    Fault("machine stalls", _machine),
    Fault("planner silent", _planner_silent, (*_SERVOJ, "can", "canopen")),
    Fault("planner's nonsense", _planner_nonsense, (*_SERVOJ, "can", "canopen")),
    Fault("arm", _arm, weight=2.0),
    Fault("disarm", _disarm, weight=2.0),
    Fault("stop", _stop, weight=0.3),
    *(Fault(name, _of_link(make), ("canopen",)) for name, make in canopen.FAMILIES),
    *(Fault(name, _of_link(make), ("ur_sensor",)) for name, make in sensor.FAMILIES),
)


def drawn(draw: Draw, link: str, count: int) -> list[Fault]:
    """Return so many faults for a link, in the order in which they happen."""
    able = [fault for fault in FAULTS if link in fault.links]
    return draw.choices(able, [fault.weight for fault in able], k=count)
