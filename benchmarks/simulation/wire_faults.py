"""What goes wrong between controller and client."""

from __future__ import annotations

import random
from typing import Any

from benchmarks.simulation import can, canopen, modbus, ur
from benchmarks.simulation.can import CanLink
from benchmarks.simulation.canopen import CanopenLink
from benchmarks.simulation.modbus import ModbusLink, ModbusTargetLink
from benchmarks.simulation.processes import Run
from benchmarks.simulation.sensor import SensorLink
from benchmarks.simulation.ur import UrLink
from benchmarks.simulation.wires import WAY

Draw = random.Random
BUSES = (CanLink, CanopenLink)
FEW = (1, 1, 2, 3, 10, 40)
LASTING = 10**9  # messages: until somebody repairs it


def delay_step(run: Run, draw: Draw) -> str:
    """Have the way be longer for good: what no clock at one end shows."""
    most = 0.3 if not isinstance(run.link, BUSES) else 0.003  # a bus has no such queue
    run.link.down.delay = WAY + draw.uniform(0.0, most) ** 1.5
    if draw.random() < 0.5:
        run.link.up.delay = WAY + draw.uniform(0.0, most) ** 1.5
    return f"down {run.link.down.delay:.4f} s, up {run.link.up.delay:.4f} s"


def grow(run: Run, draw: Draw) -> str:
    """Have the way become longer so slowly that it looks like a clock that drifts."""
    run.link.down.grow(draw.choice((5e-4, 2e-3, 4.5e-3)))
    return f"{run.link.down.growth:g} s per s"


def jitter(run: Run, draw: Draw) -> str:
    """Have each message take another while."""
    most = 0.002 if isinstance(run.link, BUSES) else 0.1
    run.link.down.jitter = draw.uniform(0.0, most)
    return f"{run.link.down.jitter:.4f} s"


def hold_back(run: Run, draw: Draw) -> str:
    """Keep messages for a while, then hand them on all at once."""
    seconds = draw.choice((0.02, 0.05, 0.1, 0.3, 0.8, 4.0)) * draw.uniform(0.5, 1.5)
    wires = draw.choice(([run.link.down], [run.link.up], [run.link.down, run.link.up]))
    if isinstance(run.link, BUSES):
        run.link.controller.stall(seconds)
        return f"arm silent for {seconds:.3f} s"
    for wire in wires:
        wire.hold(seconds)
    return f"{len(wires)} for {seconds:.3f} s"


def lose(run: Run, draw: Draw) -> str:
    """Lose a share of messages."""
    share = draw.choice((0.02, 0.2, 0.6))
    wire = draw.choice((run.link.up, run.link.down))
    wire.lost = share
    return f"{share:g} of messages"


def double(run: Run, draw: Draw) -> str:
    """Deliver a share of messages twice."""
    run.link.down.doubled = draw.choice((0.05, 0.5))
    return f"{run.link.down.doubled:g} of messages"


def spoil(run: Run, draw: Draw) -> str:
    """Have messages to the client be wrong in one place each."""
    spoiled: Any = {
        UrLink: ur.spoiled, ModbusLink: modbus.spoiled, CanopenLink: canopen.spoiled,
        SensorLink: ur.spoiled, ModbusTargetLink: modbus.spoiled,
    }.get(type(run.link))  # fmt: skip
    if isinstance(run.link, CanLink):
        spoiled = run.link.spoiled
    wire, later = run.link.down, run.later
    wire.change, wire.changed = lambda message: spoiled(message, draw), draw.choice(FEW)
    if later is not None:
        if later.random() < 0.2:
            wire.changed = LASTING
        if isinstance(run.link, UrLink) and later.random() < 0.6:
            wire.change = lambda message: ur.spoiled_anywhere(message, later)
    return f"{wire.changed} messages"


def spoil_requests(run: Run, draw: Draw) -> str:
    """Have messages to the controller be wrong in one place each."""
    spoiled: Any = modbus.spoiled_request if isinstance(run.link, ModbusLink) else ur.spoiled_order
    run.link.up.change = lambda message: spoiled(message, draw)
    run.link.up.changed = draw.choice((1, 2, 10, 40, LASTING))
    return f"{run.link.up.changed} messages"


def reorder(run: Run, draw: Draw) -> str:
    """Have later frames overtake earlier ones."""
    run.link.down._ordered = False
    run.link.down.jitter = draw.uniform(0.0, 0.02)
    return f"within {run.link.down.jitter:.4f} s"


def cut(run: Run, draw: Draw) -> str:
    """Break the connection, and refuse another for a while."""
    seconds = draw.choice((0.0, 0.0, 0.2, 1.5))
    run.link.refuses_until = run.world.now + seconds
    run.link.disconnect()
    return f"refused for {seconds:g} s"


def withhold(run: Run, draw: Draw) -> str:
    """Have one of the arm's frames not be sent."""
    link = run.link
    assert isinstance(link, CanLink)
    identifier = draw.choice((*link.arm.reports, *link.arm.others))
    link.node.withheld.add(identifier)
    run.world.after(draw.choice((0.01, 0.1, 1.0)), lambda: link.node.withheld.discard(identifier))
    return f"{identifier:#x}"


def flood(run: Run, draw: Draw) -> str:
    """Have other nodes fill the bus with frames that are nothing to us."""
    link = run.link
    assert isinstance(link, BUSES)
    seconds, each = draw.choice((0.02, 0.1, 0.4)), draw.choice((2, 8))
    known = (link.arm.reports[0], *link.arm.others[:1]) if isinstance(link, CanLink) else (0x181,)
    link.flood(seconds, each, lambda: can.foreign_frame(draw, known))
    return f"{each} frames a ms for {seconds:g} s"


def error_frames(run: Run, draw: Draw) -> str:
    """Have the adapter report errors on the bus."""
    link = run.link
    assert isinstance(link, BUSES)
    seconds = draw.choice((0.02, 0.2))
    link.flood(seconds, 1, can.error_frame)
    return f"1 a ms for {seconds:g} s"
