"""Recording: every cycle as a row of CSV in the log's own columns, written as it comes.

Each batch is handed to the system at once, so that a kill -9 loses no more than the last moment.
"""

from __future__ import annotations

import json
import time
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from bridge.cycle_row import OPTIONAL
from bridge.settings import RecordingSettings
from bridge.shared_page import slices_of
from bridge.supervisor import State
from core.errors import InputError

Array = NDArray[np.float64]
_VECTORS = (
    "target_q", "actual_q", "actual_qd", "actual_current_as_torque", "joint_temperatures",
    "payload_cog", "actual_TCP_force", "ft_raw_wrench", "nominal_q", "corrected_q", "offset",
)  # fmt: skip
_SCALARS = ("payload", "written", "age")


class Recorder:
    """Writes one run: ``run-TIME.csv``, ``run-TIME.events.jsonl`` and the loop's own output.

    Columns that the controller does not deliver are left out; which ones, the first cycle says.
    """

    def __init__(self, settings: RecordingSettings, n: int) -> None:
        self._slices = slices_of(n)
        self._every = settings.every
        self._count = 0
        self._columns: list[int] = []
        self._format = ""
        self.path: Path | None = None
        self.output: IO[bytes] | None = None
        self._csv: IO[str] | None = None
        self._events: IO[str] | None = None
        self._broken = False
        if settings.folder is not None:
            try:
                self._open(settings.folder)
            except OSError as error:
                raise InputError(
                    f"recording.folder: {settings.folder}: {error.strerror}, expected a folder "
                    "that can be written"
                ) from None

    def _open(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        stem, number = time.strftime("run-%Y%m%d-%H%M%S"), 1
        name = stem
        while True:
            try:
                self._csv = (folder / f"{name}.csv").open("x", encoding="utf-8")
                break
            except FileExistsError:
                number += 1
                name = f"{stem}-{number}"
        self.path = folder / f"{name}.csv"
        self._events = (folder / f"{name}.events.jsonl").open("w", encoding="utf-8")
        self.output = (folder / f"{name}.loop.log").open("wb")

    def write(self, rows: Array) -> None:
        """Write cycles (k, width); a full disk ends the recording, never the run."""
        if self._csv is None or self._broken or not len(rows):
            return
        first = -self._count % self._every
        self._count += len(rows)
        rows = rows[first :: self._every]
        if not len(rows):
            return
        if not self._columns:
            self._csv.write(self._header(rows[0]))
        picked = rows[:, self._columns].tolist()
        states = rows[:, 2].astype(int).tolist()
        lines = [
            self._format % (*row, State(state).name.lower())
            for row, state in zip(picked, states, strict=True)
        ]
        try:
            self._csv.writelines(lines)
            self._csv.flush()
        except OSError as error:
            self._broken = True
            self.tell({"recording": f"{self.path}: ended: {error.strerror}"})

    def _header(self, row: Array) -> str:
        names, formats = ["timestamp"], ["%.6f"]
        self._columns = [1]
        for name in (*_VECTORS, *_SCALARS):
            part = self._slices[name]
            if np.isnan(row[part]).all() and (name in OPTIONAL or name == "payload"):
                continue
            single = name in _SCALARS
            names += [name] if single else [f"{name}_{i}" for i in range(part.stop - part.start)]
            self._columns += range(part.start, part.stop)
            formats += ["%.9g"] * (part.stop - part.start)
        self._format = ",".join(formats) + ",%s\n"
        return ",".join([*names, "state"]) + "\n"

    def tell(self, event: dict[str, Any]) -> None:
        """Write an event."""
        if self._events is not None:
            self._events.write(json.dumps({"time": time.time(), **event}) + "\n")
            self._events.flush()

    def close(self) -> None:
        """Close all files."""
        for file in (self._csv, self._events, self.output):
            if file is not None:
                file.close()
        self._csv = self._events = self.output = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
