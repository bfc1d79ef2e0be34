"""The robot's own program as the bench starts it: a plain joint move."""

from __future__ import annotations

from gapbridge.drivers.simulated.peer.bench import BenchError
from gapbridge.drivers.simulated.plant.kinematics import Joints
from gapbridge.drivers.simulated.plant.motion import MoveJoints
from gapbridge.drivers.simulated.ur.controller import Controller
from gapbridge.drivers.simulated.ur.programs.offset_program import OffsetMotion

DEFAULT_SPEED = 0.5  # rad/s


def move_own(controller: Controller, goal: Joints) -> None:
    """Have the robot's own program move to `goal` (n, rad). Raises BenchError where it cannot."""
    if not controller.can_move:
        raise BenchError("move: the robot is not running")
    motion = controller.motion
    if isinstance(motion, OffsetMotion):
        motion.own = MoveJoints(motion.nominal, goal, DEFAULT_SPEED, 2.0 * DEFAULT_SPEED)
        return
    if controller.program is not None:
        raise BenchError("move: another program runs")
    controller.motion = MoveJoints(controller.target_q, goal, DEFAULT_SPEED, 1.0)
