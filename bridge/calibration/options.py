"""What a person has asked of a session on the command line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gapbridge.bridge.cell.settings.instruments import InstrumentSettings


@dataclass(frozen=True)
class SessionOptions:
    """One call of the command."""

    kind: str  # whole, verify, payload or tool
    folder: Path | None  # of the session
    instrument: InstrumentSettings
    poses: int | None = None
    plan_only: bool = False
    move: bool = False
    new_cell: Path | None = None
    yes: bool = False
    seed: int = 0
