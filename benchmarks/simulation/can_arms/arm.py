"""What an arm on CAN has of its own: which frames are targets, which report, what stops it."""

from __future__ import annotations

import random
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping

from gapbridge.drivers.clock import Clock
from gapbridge.drivers.simulated.can.nodes import CanNodes
from gapbridge.drivers.simulated.server.arm_controller import ArmController

Joints = Mapping[int, float]
"""Joint, from 0 -> rad."""


class CanArm(ABC):
    """One arm: its nodes, and its frames as a checker reads them, by the checker's own decoding."""

    reports: tuple[int, ...]  # identifiers of joints, in the order in which they are sent
    others: tuple[int, ...]  # identifiers, of further frames that can be missing
    sends: frozenset[int]  # identifiers that the client may send
    last_target: int  # identifier that makes a setpoint of the targets before it
    is_ordered = False  # a sample's frames make one in the order of ``reports`` only
    answers_at_once = False  # it speaks when it is spoken to, and between its cycles
    safe = True  # what the frames that have reached the client say of whether it may move

    def __init__(self, node: CanNodes, controller: ArmController) -> None:
        self.node, self.controller = node, controller

    @classmethod
    @abstractmethod
    def made(cls, make: Callable[[type[CanNodes]], CanNodes], clock: Clock) -> CanNodes:
        """Return the arm's nodes, made of their class."""

    @abstractmethod
    def targets(self, identifier: int, data: bytes) -> Joints:
        """Return the joints that a frame of the client commands; none where it is no target."""

    @abstractmethod
    def joints(self, identifier: int, data: bytes) -> Joints:
        """Return the joints that one of ``reports`` has; none where it is malformed."""

    def reports_a_sample(self, identifier: int, sampled: float) -> bool:
        """Return whether a frame of joints that was sent then belongs to a sample."""
        return True

    @abstractmethod
    def look(self, identifier: int, data: bytes) -> None:
        """See in a frame that has reached the client whether the arm may move."""

    def sent(self, identifier: int, data: bytes) -> None:
        """See a frame of the client that is no target."""

    def taken(self, identifier: int, data: bytes, now: float) -> None:
        """See a frame of the client as it reaches the arm."""

    def altered(self, identifier: int, data: bytes) -> bytes:
        """Return a frame as it leaves the arm, with what a fault has it say."""
        return data

    @abstractmethod
    def enter_mode(self, draw: random.Random) -> str:
        """Have the arm be in a mode in which it does not move; returns it in words."""

    @abstractmethod
    def leave_mode(self) -> None:
        """Have the arm be ready to be armed again."""

    @abstractmethod
    def forget(self) -> None:
        """Be as after switching on."""

    @abstractmethod
    def foreign_target(self) -> tuple[int, bytes]:
        """Return a target of another commander: where the arm is."""
