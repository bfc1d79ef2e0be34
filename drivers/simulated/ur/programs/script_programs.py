"""Any other program that a client uploads: straight lines of known calls, run one after the other.

Not an interpreter of URScript: loops, branches and unknown calls are logged and passed over.
"""

from __future__ import annotations

import logging
from typing import Any

from gapbridge.drivers.simulated.plant.kinematics import Joints, frame_of
from gapbridge.drivers.simulated.plant.motion import MoveJoints, Stop
from gapbridge.drivers.simulated.server.bench import BenchError
from gapbridge.drivers.simulated.ur.controller import CYCLE, Controller, ScriptError, Steps
from gapbridge.drivers.simulated.ur.programs.offset_program import OffsetMotion
from gapbridge.drivers.simulated.ur.programs.path_program import MOVES, make_move
from gapbridge.drivers.simulated.ur.programs.script_text import Call, parse_assignment, parse_call

log = logging.getLogger("drivers.simulated")
DEFAULT_SPEED = 0.5  # rad/s
STOPS = ("stopj", "stopl")
MOVING = (*MOVES, *STOPS)
DIGITAL_OUTPUTS = 18  # standard, configurable, tool
LARGEST_INTEGER = 1 << 31


def script_program(
    controller: Controller, name: str, lines: tuple[str, ...], secondary: bool = False
) -> Steps:
    """Run the lines of a program; it ends in the cycle of its last line, as clients expect.

    A ``secondary`` one cannot move the arm. Raises ScriptError for a line that cannot be executed.
    """
    variables: dict[str, Any] = {"True": True, "False": False}
    for text in lines:
        line = text.split("#")[0].strip()
        if not line:
            continue
        call = parse_call(line, variables)
        if call is not None:
            if secondary and call.name in MOVING:
                raise ScriptError(f"{call.name} in a secondary program, which cannot move the arm")
            try:
                yield from _run(controller, name, call)
            except (TypeError, ValueError, KeyError, OverflowError) as error:
                raise ScriptError(f"{line!r} cannot be executed: {error}") from None
            continue
        assigned = parse_assignment(line, variables)
        if assigned is not None:
            variables[assigned[0]] = assigned[1]
        else:
            log.warning("program %s: line %r is not understood and passed over", name, line)


def _run(controller: Controller, name: str, call: Call) -> Steps:
    """Run one call, over as many cycles as it takes."""
    if call.name in MOVES:
        yield from controller.run_motion(make_move(controller, call, controller.target_q))
    elif call.name in STOPS:
        rate = max(float(call.get(0, "a", 2.0)), 0.1)
        yield from controller.run_motion(Stop(controller.target_qd, rate))
    elif call.name == "sleep":
        for _ in range(round(float(call.get(0, "t", 0.0)) / CYCLE)):
            yield
    elif call.name == "sync":
        yield
    elif not _set(controller, call):
        log.warning("program %s: call of %s is not understood and passed over", name, call.name)


def _set(controller: Controller, call: Call) -> bool:
    """Run an immediate call; returns False for an unknown one."""
    memory, declared = controller.memory, controller.declared
    first = call.get(0, "n", None)
    if call.name.startswith("write_output_"):
        _write_output(memory, call)
    elif call.name in ("set_payload", "set_target_payload"):
        x, y, z = call.get(1, "cog", declared.payload_cog)
        mass = float(call.get(0, "m", 0.0))
        declared.set_payload(mass, (float(x), float(y), float(z)))
    elif call.name == "set_tcp":
        a, b, c, d, e, f = controller.finite(call.get(0, "pose", ()), "set_tcp")
        declared.set_tcp((a, b, c, d, e, f))
        frame_of(declared.tcp)
    elif call.name == "zero_ftsensor":
        controller.sensors.zero()
    elif call.name == "protective_stop":
        controller.protective_stop()
    elif call.name in ("set_standard_digital_out", "set_digital_out"):
        if not 0 <= int(first) < DIGITAL_OUTPUTS:
            raise ScriptError(f"{call.name}: there is no output {first}")
        bits, mask = memory["actual_digital_output_bits"], 1 << int(first)
        memory["actual_digital_output_bits"] = bits | mask if call.get(1, "b", 0) else bits & ~mask
    elif call.name == "textmsg":
        log.info("textmsg: %s", call.arguments)
    else:
        return False
    return True


def _write_output(memory: dict[str, Any], call: Call) -> None:
    """Write an output register. Raises ScriptError for another one, or what it cannot hold."""
    kind = {"integer": "int", "float": "double", "boolean": "bit"}[call.name.split("_")[2]]
    register, value = f"output_{kind}_register_{int(call.get(0, 'n', -1))}", call.get(1, "value", 0)
    number = float(value)
    whole = number.is_integer() and -LARGEST_INTEGER <= number < LARGEST_INTEGER
    if register not in memory or (kind == "int" and not whole):
        raise ScriptError(f"{call.name}: {register} cannot be set to {value!r}")
    memory[register] = {"int": int, "double": float, "bit": bool}[kind](value)


def move_own(controller: Controller, goal: Joints) -> None:
    """Let the robot's own program move to `goal` (n, rad). Raises BenchError if it cannot."""
    if not controller.can_move:
        raise BenchError("move: the robot is not running")
    motion = controller.motion
    if isinstance(motion, OffsetMotion):
        motion.move_own(goal, DEFAULT_SPEED, 2.0 * DEFAULT_SPEED)
        return
    if controller.program is not None:
        raise BenchError("move: another program runs")
    controller.start_motion(MoveJoints(controller.target_q, goal, DEFAULT_SPEED, 1.0))
