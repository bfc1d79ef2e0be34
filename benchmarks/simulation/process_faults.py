"""What goes wrong on our machine, and what people ask of the daemon."""

from __future__ import annotations

import itertools
import linecache
import random
import sys
from typing import Any

import numpy as np

from benchmarks.simulation.planner import Nonsense, Vector
from benchmarks.simulation.processes import Run

Draw = random.Random


def spoil_model(run: Run, draw: Draw) -> str:
    """Have the correction be no number, or far too large."""
    loop = run.loops[-1].loop
    if loop is None:
        return "no loop"
    compensator = loop._stream._compensator
    correct, bad = compensator.correct, draw.choice((np.nan, np.inf, 0.5))

    shift = np.full(run.link.controller.n, bad)
    if run.later is not None and run.planner is not None:
        shift[run.planner.joint] = 0.0  # what that one does is taken for the plan's

    def spoiled(*given: Any) -> Any:
        found = correct(*given)
        return found._replace(q=found.q + shift) if hasattr(found, "_replace") else found

    if draw.random() < 0.5:
        run.world.after(0.05, lambda: setattr(compensator, "correct", correct))
    compensator.correct = spoiled  # type: ignore[method-assign]
    return f"{bad:g}"


def stall(run: Run, draw: Draw) -> str:
    """Have the loop's process stand still at any of its lines, or between two cycles."""
    seconds, process = draw.choice((0.003, 0.03, 0.06, 0.2, 0.6, 1.5)), run.loops[-1].process
    if draw.random() < 0.3:
        process.freeze(seconds)
        return f"{seconds:g} s, waiting"
    lines = draw.randint(1, 600)

    def stand() -> None:
        at = sys._getframe(2)  # the product's, at that line
        begins = ".write_setpoint(" in linecache.getline(at.f_code.co_filename, at.f_lineno)
        # between check and sending nothing shows that in time (docs/evidence/fault-method.md)
        if not (run.link.sends or begins):
            process.stand_still(seconds)

    process.at_line(lines, stand)
    return f"{seconds:g} s, {lines} lines on"


def die(run: Run, draw: Draw) -> str:
    """Kill the loop at any of its lines, or between two cycles."""
    process = run.loops[-1].process
    if draw.random() < 0.3:
        process.kill()
        return "waiting"
    lines = draw.randint(1, 600)
    process.at_line(lines, process.kill)
    return f"{lines} lines on"


def die_daemon(run: Run, draw: Draw) -> str:
    """Kill the daemon at any of its lines, or while it waits, and start it anew."""
    run.start_anew(draw.uniform(0.05, 0.5), arms := draw.random() < 0.3)
    words = "; the cell file arms" if arms else ""
    if draw.random() < 0.3:
        run.kill_daemon()
        return f"waiting{words}"
    lines = draw.randint(1, 600)
    run.process.at_line(lines, run.kill_daemon)
    return f"{lines} lines on{words}"


def restart_daemon(run: Run, draw: Draw) -> str:
    """Ask the daemon to end (SIGTERM), and start it anew."""
    run.stop()
    run.start_anew(draw.uniform(0.05, 0.5), arms := draw.random() < 0.3)
    return "the cell file arms" if arms else ""


def stall_daemon(run: Run, draw: Draw) -> str:
    """Have the daemon stand still."""
    seconds = draw.choice((0.05, 0.3, 1.2))
    run.process.freeze(seconds)
    return f"{seconds:g} s"


def stall_machine(run: Run, draw: Draw) -> str:
    """Have all processes stand still."""
    seconds = draw.choice((0.01, 0.08, 0.5))
    run.process.freeze(seconds)
    run.loops[-1].process.freeze(seconds)
    return f"{seconds:g} s"


def silence_planner(run: Run, draw: Draw) -> str:
    """Have the planner send nothing."""
    if run.planner is None:
        return "no planner"
    run.planner.silent_until = run.world.now + draw.choice((0.05, 0.3, 2.0))
    return ""


def plan_nonsense(run: Run, draw: Draw) -> str:
    """Have the planner send what no arm can follow."""
    planner = run.planner
    if planner is None:
        return "no planner"
    step = draw.choice((0.02, 0.3, 1.5, 9.0, float("nan")))
    joint = planner.joint
    planner.nonsense, words = _stepped(joint, step), f"{step:g} rad"
    later = run.later
    if later is not None and later.random() < 0.6:
        kind = later.choice(("to and fro", "no number in any joint", "zero"))
        other = later.randrange(run.link.controller.n)
        planner.nonsense = {
            "to and fro": _to_and_fro(joint, later.choice((0.02, 0.3))),
            "no number in any joint": _set_to(other, float("nan")),
            "zero": _set_to(joint, 0.0),
        }[kind]
        words = kind
    run.world.after(draw.choice((0.03, 0.2)), lambda: setattr(planner, "nonsense", None))
    return words


def _stepped(joint: int, step: float) -> Nonsense:
    def nonsense(q: Vector) -> Vector:
        q[joint] += step
        return q

    return nonsense


def _to_and_fro(joint: int, step: float) -> Nonsense:
    signs = itertools.cycle((1.0, -1.0))

    def nonsense(q: Vector) -> Vector:
        q[joint] += next(signs) * step
        return q

    return nonsense


def _set_to(joint: int, value: float) -> Nonsense:
    def nonsense(q: Vector) -> Vector:
        q[joint] = value
        return q

    return nonsense


def set_calendar(run: Run, draw: Draw) -> str:
    """Set the machine's calendar, as a time server does; the monotonic clock goes on."""
    step = draw.choice((-3600.0, -0.5, 0.5, 3600.0, 86400.0))
    run.clock.calendar += step
    return f"{step:g} s"


def reload(run: Run, draw: Draw) -> str:
    """Have the cell file be read again (SIGHUP): wrong, the same, or with narrow limits."""
    run.cell_file = draw.choice(("wrong", "wrong", "same", "narrow"))
    run.daemon.reload()
    return run.cell_file


def arm(run: Run, draw: Draw) -> str:
    """Ask for writing."""
    run.daemon.arm("somebody")
    return ""


def disarm(run: Run, draw: Draw) -> str:
    """Ask for observing."""
    run.daemon.disarm("somebody")
    return ""


def stop(run: Run, draw: Draw) -> str:
    """Ask the daemon to end."""
    run.stop()
    return ""


def fill_disk(run: Run, draw: Draw) -> str:
    """Have the disk take nothing more, for a while."""
    disk, seconds = run.disk, draw.choice((0.1, 0.6, 3.0))
    assert disk is not None
    disk.is_full = True
    run.world.after(seconds, lambda: setattr(disk, "is_full", False))
    return f"{seconds:g} s"


def kill_recorder(run: Run, draw: Draw) -> str:
    """Kill the recorder at any of its lines, or while it waits."""
    recording, lines = run.recordings[-1], draw.randint(1, 3000)
    if draw.random() < 0.3:
        recording.die()
        return "waiting"
    recording.process.at_line(lines, recording.die)
    return f"{lines} lines on"


def cut_power(run: Run, draw: Draw) -> str:
    """Cut the power of our machine, and switch it on again."""
    run.start_anew(draw.uniform(0.5, 2.0), arms := draw.random() < 0.5)
    run.cut_power()
    return "the cell file arms" if arms else ""
