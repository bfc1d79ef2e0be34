"""Where the arm stands, and how a session learns it: one base, a member for each way."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from gapbridge.bridge.calibration.instruments.instrument import Ask, ReadingError
from gapbridge.bridge.calibration.instruments.numbers import numbers
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import RunError


@dataclass(frozen=True)
class JointSample:
    """The arm at rest; a field that nobody reports is None."""

    q: Array  # (n,) rad
    temperature: Array | None = None  # (n,) °C
    wrench: Array | None = None  # (6,) N, Nm: actual_TCP_force
    raw_wrench: Array | None = None  # (6,) N, Nm: ft_raw_wrench
    payload: float | None = None  # kg, declared in the controller
    approach: Array | None = None  # (n,) sign of each joint's last motion


class JointSource(ABC):
    """Reports where the arm stands. The constructor opens nothing."""

    drives = False  # whether ``drive`` works
    watches = False  # whether ``arrived`` can decide by itself

    def open(self) -> None:
        """Get ready. Raises InputError or LinkError."""

    def close(self) -> None:
        """Let go. Never raises."""

    def arrived(self, pose: PlannedPose) -> JointSample | None:
        """Return where the arm rests, once it does so near the pose; None before."""
        return None

    def now(self) -> Array | None:
        """Return the joints (n,) at this moment, None where nobody knows."""
        return None

    @abstractmethod
    def stand(self, pose: PlannedPose) -> JointSample:
        """Return where the arm stands, at rest. Raises ReadingError where it does not."""

    def still(self, stand: JointSample) -> bool:
        """Return whether the arm has not moved since."""
        return True

    def drive(self, pose: PlannedPose, via: Sequence[Array] = ()) -> None:
        """Move the arm to a pose, by joints ``via`` (n,) in turn. Raises RunError."""
        raise RunError("this session does not move the arm")

    def __enter__(self) -> Self:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class PlannedJoints(JointSource):
    """The arm's own program brings it exactly to the planned poses."""

    def stand(self, pose: PlannedPose) -> JointSample:
        """Return the planned joints."""
        return JointSample(pose.q)


class TypedJoints(JointSource):
    """A person reads the pendant, in degrees."""

    def __init__(self, ask: Ask, seated: bool = False) -> None:
        self._ask, self._seated = ask, seated

    def stand(self, pose: PlannedPose) -> JointSample:
        """Return what is typed; Enter alone: exactly as planned. Raises ReadingError.

        Where the tool is ``seated`` by hand the joints are the reading, and Enter reports none.
        """
        n = len(pose.q)
        exactly = "" if self._seated else " (Enter: exactly as planned)"
        line = self._ask(f"joints J1..J{n}, deg{exactly}")
        if not line and self._seated:
            raise ReadingError("found nothing, expected where the arm stands now, in degrees")
        if not line:
            return JointSample(pose.q)
        given = np.array(numbers(line, n, "deg"))
        if np.abs(given).max() > 720.0:
            raise ReadingError(f"found {np.abs(given).max():g} deg, expected at most two turns")
        if np.abs(given).max() < 2.0 * np.pi and np.abs(given - pose.q).max() < 0.1:
            raise ReadingError("found what look like radians, expected degrees")
        return JointSample(np.radians(given))
