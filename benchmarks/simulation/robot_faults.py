"""What goes wrong in the controller, and what people do at it."""

from __future__ import annotations

import random

from benchmarks.simulation.modbus import ModbusLink
from benchmarks.simulation.processes import Run
from benchmarks.simulation.ur import UrLink
from benchmarks.simulation.wire_faults import BUSES

Draw = random.Random


def restart(run: Run, draw: Draw) -> str:
    """Have the controller start anew."""
    seconds = draw.uniform(0.05, 1.0)
    run.link.restart(seconds)
    return f"{seconds:.2f} s"


def freeze_clock(run: Run, draw: Draw) -> str:
    """Have the controller's clock stand."""
    controller, seconds = run.link.controller, draw.choice((0.02, 0.1, 0.5, 2.0))
    controller.frozen = True
    run.world.after(seconds, lambda: setattr(controller, "frozen", False))
    return f"{seconds:g} s"


def freeze_values(run: Run, draw: Draw) -> str:
    """Have the joints that are reported stand."""
    run.link.freezes_values = True
    return "for good"


def pace(run: Run, draw: Draw) -> str:
    """Have the controller's clock be fast or slow."""
    # faster by at most what the gate allows for; slower ones only look older than they are
    run.link.pace = 1.0 + draw.choice((1e-4, 2e-3, 0.02, -1e-4, -2e-3, -0.02, -0.2))
    return f"{run.link.pace:g}"


def jump(run: Run, draw: Draw) -> str:
    """Set the controller's clock."""
    step = draw.choice((-1, 1)) * draw.choice((0.01, 0.05, 0.3, 5.0))
    run.link.controller.clock = max(run.link.controller.clock + step, 0.0)
    return f"{step:g} s"


def protective_stop(run: Run, draw: Draw) -> str:
    """Have the arm stop as at a collision."""
    run.link.controller.protective_stop()
    return ""


def emergency_stop(run: Run, draw: Draw) -> str:
    """Press the button."""
    run.link.controller.emergency_stop()
    return ""


def brief_stop(run: Run, draw: Draw) -> str:
    """Stop, and release it soon."""
    controller, seconds = run.link.controller, draw.uniform(0.005, 0.1)
    controller.protective_stop()
    run.world.after(seconds, controller.unlock)
    return f"{seconds:.3f} s"


def payload(run: Run, draw: Draw) -> str:
    """Declare another payload in the controller."""
    mass = draw.choice((0.0, 2.0, 8.0, 60.0, 900.0, -1.0))
    run.link.declare(mass)
    return f"{mass:g} kg"


def tcp(run: Run, draw: Draw) -> str:
    """Declare another TCP in the controller."""
    shift = draw.choice((0.001, 0.02, 0.2))
    run.link.controller.declared.set_tcp((shift, 0.0, 0.18, 0.0, 0.0, 0.0))
    return f"{shift:g} m"


def speed(run: Run, draw: Draw) -> str:
    """Move the speed slider."""
    link = run.link
    assert isinstance(link, UrLink)
    link.speed = draw.choice((0.0, 0.3, 0.97, 3.0, float("nan")))
    return f"{link.speed:g}"


def end_program(run: Run, draw: Draw) -> str:
    """Have the robot's program end."""
    link = run.link
    if isinstance(link, ModbusLink):
        link.program.running = False
    elif isinstance(link, UrLink):
        link.foreign(0.0)
    return ""


def foreign(run: Run, draw: Draw) -> str:
    """Have somebody else command the arm."""
    seconds = draw.choice((0.0, 0.1, 0.6))
    run.link.foreign(seconds)
    return f"{seconds:g} s"


def refuse(run: Run, draw: Draw) -> str:
    """Have the controller refuse writes."""
    link = run.link
    if isinstance(link, UrLink):
        link.refuses_servo = True
    elif isinstance(link, BUSES):
        link.refuses_frames = True
        run.world.after(draw.uniform(0.01, 0.3), lambda: setattr(link, "refuses_frames", False))
    return ""


def pace_of_cycles(run: Run, draw: Draw) -> str:
    """Have the controller's cycles be shorter or longer: it has no clock that says so."""
    run.link.pace_of_cycles = 1.0 + draw.choice((1e-4, 2e-3, 0.02, 0.1, -2e-3, -0.02, -0.2))
    return f"{run.link.pace_of_cycles:g}"


def mode(run: Run, draw: Draw) -> str:
    """Have the robot be in a mode in which it does not move, for a while or for good."""
    words, link = run.link.enter_mode(draw), run.link
    if draw.random() < 0.6:
        run.world.after(draw.choice((0.02, 0.1, 0.4)), link.leave_mode)
    return words


def pause_program(run: Run, draw: Draw) -> str:
    """Have the robot's program stand still, for a while or for good."""
    seconds = draw.choice((0.02, 0.1, 0.5, 60.0))
    run.link.paused_until = run.world.now + seconds
    return f"{seconds:g} s"


def local_mode(run: Run, draw: Draw) -> str:
    """Have the controller take no script from a client."""
    assert isinstance(run.link, UrLink)
    run.link.is_remote = False
    return ""
