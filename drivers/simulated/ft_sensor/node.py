"""A simulated sensor: a thread on its wire while the ``with`` block lasts."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from typing import Self

import numpy as np

from gapbridge.drivers.simulated.ft_sensor.mounting import Reaction


class SimulatedSensor(ABC):
    """What the simulated sensors share: what they measure, faults, start and stop."""

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
        found = [round(v * k) for v, k in zip(self.reaction(), scale, strict=True)]
        return [int(v) for v in np.clip(found, -32768, 32767)]

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
