"""Cycles as the loop hands them over, and recorders of them, for the tests of recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.cell.settings.recording import RecordingSettings
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.bridge.ipc.shared_memory import SharedMemory
from gapbridge.bridge.recording.recorder import Recorder
from gapbridge.drivers.clock import SYSTEM

N = 6
SESSION = "run-20260101-000000"
CONFIGURATION = {"program": "test", "cell": "cell.yaml", "sha256": "00", "text": "", "joints": N}
Array = NDArray[np.float64]


def publish(memory: SharedMemory, count: int, seed: int = 0) -> Array:
    """Have a loop publish cycles of random numbers; returns them as rows (count, width)."""
    random = np.random.default_rng(seed)
    rows = []
    for _ in range(count):
        row = memory.next_row()
        number = memory.written
        row[1:] = random.standard_normal(memory.width - 1)
        row[memory.slices["timestamp"]] = 0.002 * number
        row[memory.slices["received"]] = 1000.0 + 0.002 * number
        row[memory.slices["state"]] = State.OBSERVING
        row[memory.slices["joint_temperatures"]] = np.nan
        memory.publish()
        rows.append(row.copy())
    return np.array(rows)


class Desk:
    """Shared memory, and recorders on it one after the other."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.folder = folder
        self.memory = SharedMemory(N, clock=SYSTEM)
        self.events: list[dict[str, Any]] = []
        self.settings = RecordingSettings(folder=folder, **{"keep_free": 0.0, **settings})

    def recorder(self) -> Recorder:
        return Recorder(
            self.settings, SESSION, self.memory, CONFIGURATION, self.events.append, clock=SYSTEM
        )

    def record(self, *counts: int) -> Array:
        """Record so many cycles, a flush after each; returns the rows."""
        recorder = self.recorder()
        rows = []
        for k, count in enumerate(counts):
            rows.append(publish(self.memory, count, seed=k))
            recorder.step(flush=True)
        recorder.close()
        return np.concatenate(rows)

    @property
    def files(self) -> list[Path]:
        return sorted(self.folder.glob("*.mcap"))

    @property
    def stem(self) -> Path:
        return self.folder / SESSION


def same_bits(found: Array, expected: Array) -> bool:
    """Return whether two arrays are the same, sign of zero and NaN included."""
    return found.shape == expected.shape and found.tobytes() == expected.tobytes()
