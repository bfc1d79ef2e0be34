"""A simulated sensor: a thread on its wire while the ``with`` block lasts."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Self

import numpy as np

from gapbridge.drivers.simulated.plant.plant_settings import Vector6
from gapbridge.drivers.simulated.plant.rotations import (
    Vector3,
    compose,
    cross,
    from_vector,
    subtract,
    unrotate,
)

Reaction = Callable[[], Vector6]
"""Returns the wrench that a sensor measures now, N and Nm, in its own axes, about its origin."""


class SimulatedSensor(ABC):
    """Base class of simulated sensors: measured wrench, faults, start and stop."""

    def __init__(self, reaction: Reaction) -> None:
        self.reaction = reaction
        self.silent = False  # fault: answers and sends nothing
        self.status = 0  # fault: its status or overload bits
        self._ended = threading.Event()
        self._thread: threading.Thread | None = None

    @abstractmethod
    def open(self) -> None:
        """Open the wire. Raises LinkError."""

    @abstractmethod
    def serve(self) -> None:
        """Serve until ``_ended`` is set; runs in the thread."""

    @abstractmethod
    def close_wire(self) -> None:
        """Close the wire; may be repeated."""

    def start(self) -> None:
        """Open the wire and serve in a thread. Raises LinkError."""
        self._ended.clear()
        self.open()
        self._thread = threading.Thread(target=self.serve, name="simulated sensor", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread and close the wire; may be repeated."""
        self._ended.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(5.0)
        self.close_wire()

    def counts(self, per_newton: float, per_newton_metre: float) -> list[int]:
        """Return the wrench as int16 counts (6,), held at the end of the range."""
        scale = 3 * (per_newton,) + 3 * (per_newton_metre,)
        scaled = [round(v * k) for v, k in zip(self.reaction(), scale, strict=True)]
        return [int(v) for v in np.clip(scaled, -32768, 32767)]

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def reaction_at(
    in_flange: Callable[[], Sequence[float]], xyz: Vector3, rpy: Vector3, sign: int = 1
) -> Reaction:
    """Return what a sensor mounted at ``xyz``, ``rpy`` measures of the flange's wrench (6,).

    ``sign`` -1: it reports the reaction.
    """
    roll, pitch, yaw = (
        from_vector(tuple(angle if i == axis else 0.0 for i in range(3)))
        for axis, angle in enumerate(rpy)
    )
    rotation = compose(yaw, compose(pitch, roll))

    def reaction() -> Vector6:
        a, b, c, d, e, f = in_flange()
        force = (a, b, c)
        torque = subtract((d, e, f), cross(xyz, force))
        wrench = (*unrotate(rotation, force), *unrotate(rotation, torque))
        u, v, w, x, y, z = (sign * value for value in wrench)
        return (u, v, w, x, y, z)

    return reaction
