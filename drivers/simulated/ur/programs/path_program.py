"""A path of moves, as ur_rtde writes it into its control script: one move a line.

Blends are not driven: the arm passes through every waypoint and stops there.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial

from gapbridge.drivers.simulated.plant.kinematics import Joints, frame_of, solve, tcp_in_base
from gapbridge.drivers.simulated.plant.motion import Motion, MoveJoints, MoveLine, MovePath
from gapbridge.drivers.simulated.ur.controller import Controller, ScriptError
from gapbridge.drivers.simulated.ur.programs.script_text import Call, Pose, parse_call

log = logging.getLogger("drivers.simulated")

MOVES = ("movej", "movel", "movep")


def make_move(controller: Controller, call: Call, start: Joints) -> Motion:
    """Return the motion of a movej, movel or movep call from `start`.

    Raises ScriptError for a goal that is no pose and no joints, or cannot be reached.
    """
    arm, tool = controller.plant.arm, controller.declared.tool
    goal = call.get(0, "q" if call.name == "movej" else "pose", None)
    if not isinstance(goal, tuple) or len(goal) != len(start):
        raise ScriptError(f"{call.name} needs six numbers, got {goal!r}")
    goal = type(goal)(controller.finite(goal, call.name))
    acceleration = float(call.get(1, "a", 1.2))
    speed = float(call.get(2, "v", 1.05 if call.name == "movej" else 0.25))
    if speed <= 0.0 or acceleration <= 0.0:
        raise ScriptError(f"{call.name}: speed and acceleration must be positive")
    if call.name != "movej":
        frame = frame_of(goal) if isinstance(goal, Pose) else tcp_in_base(arm, goal, tool)
        return MoveLine(arm, tool, start, frame, speed, acceleration)
    joints: Joints | None = goal
    if isinstance(goal, Pose):
        joints = solve(arm, frame_of(goal), start, tool)
    if joints is None:
        raise ScriptError("movej: no joints reach that pose")
    return MoveJoints(start, joints, speed, acceleration)


def path_motion(
    controller: Controller, lines: tuple[str, ...], progress: Callable[[int], None]
) -> Motion:
    """Return the motion of a path; `progress` is called with the number of each waypoint begun."""
    makers: list[Callable[[Joints], Motion]] = []
    for line in lines:
        call = parse_call(line)
        if call is not None and call.name in MOVES:
            makers.append(partial(make_move, controller, call))
        elif call is None or "progress" not in call.name:
            log.warning("path: line %r is ignored", line)

    def reached(index: int) -> None:
        if index > 0:
            progress(index)

    return MovePath(makers, reached)
