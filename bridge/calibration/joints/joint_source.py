"""Where the joint angles of a reading come from: base class, planned and typed joints."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Self

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import Ask, ReadingError
from gapbridge.bridge.calibration.instruments.numbers import parse_numbers
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import RunError


@dataclass(frozen=True)
class JointSample:
    """The state of the arm at rest; a field that is not reported is None."""

    q: Array  # (n,) rad
    temperature: Array | None = None  # (n,) °C
    wrench: Array | None = None  # (6,) N, Nm: actual_TCP_force
    raw_wrench: Array | None = None  # (6,) N, Nm: ft_raw_wrench
    payload: float | None = None  # kg, declared in the controller
    approach: Array | None = None  # (n,) sign of each joint's last motion


class JointSource(ABC):
    """Source of joint angles. The constructor opens nothing."""

    can_move = False  # whether ``move_to`` works
    detects_rest = False  # whether ``arrived`` reads the arm itself

    def open(self) -> None:
        """Connect. Raises InputError, LinkError."""

    def close(self) -> None:
        """Disconnect. Never raises."""

    def arrived(self, pose: PlannedPose) -> JointSample | None:
        """Return a sample once the arm is at rest near the pose; None before."""
        return None

    def current_q(self) -> Array | None:
        """Return the present joint angles (n,), rad; None if they are unknown."""
        return None

    @abstractmethod
    def sample_at_rest(self, pose: PlannedPose) -> JointSample:
        """Return a sample of the arm at rest. Raises ReadingError if it does not come to rest."""

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Observe the arm while the block runs, for ``unmoved_since``."""
        yield

    def unmoved_since(self, sample: JointSample) -> bool:
        """Return whether the arm has not moved since the sample; raises ReadingError: unknown.

        ``sample``: the newest one. A motion to and fro is noticed in a block that is watched.
        """
        return True

    def move_to(self, pose: PlannedPose, via: Sequence[Array] = ()) -> None:
        """Move the arm to a pose through joint angles ``via``, each (n,) rad.

        Raises RunError if the move fails, LinkError if the arm cannot be observed any more.
        """
        raise RunError("this session does not move the arm")

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class PlannedJoints(JointSource):
    """The arm's own program moves it exactly to the planned poses."""

    def sample_at_rest(self, pose: PlannedPose) -> JointSample:
        """Return the planned joint angles."""
        return JointSample(pose.q)


class TypedJoints(JointSource):
    """The operator types the joint angles of the pendant, in degrees."""

    def __init__(self, ask: Ask, contact: bool = False) -> None:
        self._ask, self._contact = ask, contact

    def sample_at_rest(self, pose: PlannedPose) -> JointSample:
        """Return the typed joint angles; Enter alone: as planned. Raises ReadingError.

        With ``contact`` the joint angles are the reading, and Enter alone is not accepted.
        """
        n = len(pose.q)
        hint = "" if self._contact else " (Enter: exactly as planned)"
        line = self._ask(f"joints J1..J{n}, deg{hint}")
        if not line and self._contact:
            raise ReadingError("found nothing, expected where the arm stands now, in degrees")
        if not line:
            return JointSample(pose.q)
        angles = np.array(parse_numbers(line, n, "deg"))
        if np.abs(angles).max() > 720.0:
            raise ReadingError(f"found {np.abs(angles).max():g} deg, expected at most two turns")
        if np.abs(angles).max() < 2.0 * np.pi and np.abs(angles - pose.q).max() < 0.1:
            raise ReadingError("found what look like radians, expected degrees")
        return JointSample(np.radians(angles))
