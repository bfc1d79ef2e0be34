"""Options of `gapbridge calibrate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.cell.settings.instruments import InstrumentSettings


@dataclass(frozen=True)
class SessionOptions:
    """The options of one call."""

    kind: str  # whole, verify, payload or tool: a key of run.JOBS
    folder: Path | None  # of the session; None: the latest unfinished one, or a new one
    instrument: InstrumentSettings
    poses: int | None = None  # to fit; None: as in the cell
    plan_only: bool = False
    move: bool = False  # the arm is moved after confirmation
    new_cell: Path | None = None
    yes: bool = False  # write the new cell without asking
    seed: int = 0
