"""Facts of a session for its report that are not readings: who, where, when, with what."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path


@dataclass(frozen=True)
class InstrumentFacts:
    """The instrument by its data sheet, its certificate and the operator."""

    name: str
    kind: str = "position"  # key of core.calibration.observables.OBSERVABLES
    serial: str = ""
    certificate: str = ""  # number or date of its own calibration
    sigma: float = 2.0e-5  # m, 1 sigma of one coordinate of a single reading, as declared
    distance: float = 0.0  # m, usual distance from the instrument to the target


@dataclass(frozen=True)
class SessionFacts:
    """One session; the report omits empty fields."""

    cell: str  # name of the cell
    arm: str
    instrument: InstrumentFacts
    folder: Path  # of the session
    started: datetime
    ended: datetime
    readings: int  # accepted ones
    undone: int = 0  # discarded by the operator
    serial: str = ""  # of the arm
    operator: str = ""
    customer: str = ""
    environment: str = ""  # temperature, place, ...
    number: str = ""  # of the report
    version: str = ""  # of Gapbridge
    cell_sha256: str = ""  # of the cell file that was calibrated
    accuracy: float | None = None  # m, required; None: no requirement
    remarks: tuple[str, ...] = field(default=())  # notes and irregularities
