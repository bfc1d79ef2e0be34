"""The facts of a session for its report: who, where, when, with which instrument."""

from __future__ import annotations

from datetime import datetime

import numpy as np

from gapbridge.bridge.calibration.options import SessionOptions
from gapbridge.bridge.calibration.report import InstrumentFacts, SessionFacts
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell import Cell
from gapbridge.bridge.document.provenance import digest, installed_version

INSTRUMENT_NAMES = {
    "typed": "readings typed at the terminal",
    "file": "readings from a file",
    "folder": "files exported by the instrument's software",
    "line_feed": "lines sent by the instrument's software",
    "dial_gauge": "dial gauge or ballbar, read by the operator",
    "two_balls": "two balls, read by the operator",
    "sphere": "probe on a fixed sphere",
    "point": "tip on a fixed point",
    "simulated_tracker": "simulated laser tracker",
}


def session_facts(
    cell: Cell, options: SessionOptions, session: Session, device: tuple[str, str] | None = None
) -> SessionFacts:
    """Return the facts of a session.

    ``device``: name and kind of readings, if not those of the chosen instrument.
    """
    settings, instrument = cell.calibration, options.instrument
    name, kind = device or (INSTRUMENT_NAMES[instrument.kind], instrument.measures)
    times = [r.time for r in session.accepted] or [float(session.start_entry["time"])]
    lengths = {"position": 3, "pose": 3, "distance": 1}.get(kind, 0)  # 0: no distance is measured
    distances = [np.linalg.norm(r.value[:lengths]) for r in session.accepted if lengths]
    started = datetime.fromtimestamp(float(session.start_entry["time"]))
    return SessionFacts(
        cell=cell.path.stem,
        arm=cell.arm.name,
        serial=settings.serial,
        operator=settings.operator,
        customer=settings.customer,
        environment=settings.environment,
        instrument=InstrumentFacts(
            name=name, kind=kind, serial="" if device else instrument.serial,
            certificate="" if device else instrument.certificate,
            sigma=instrument.sigma or cell.metrology.sigma,
            distance=float(np.median(distances)) if distances else 0.0,
        ),
        folder=session.journal.path.parent,
        started=started,
        ended=datetime.fromtimestamp(max(times)),
        readings=len(session.accepted),
        undone=session.undone,
        number=_number(started, session),
        version=installed_version(),
        cell_sha256=digest(cell.path) or "",
        accuracy=settings.accuracy,
        remarks=tuple(_remarks(session)),
    )  # fmt: skip


def _number(started: datetime, session: Session) -> str:
    """Return the report's number: start of the session and a digest of its journal."""
    content = digest(session.journal.path) or ""
    return f"GB-{started:%Y%m%d-%H%M}-{content[:8]}"


def _remarks(session: Session) -> list[str]:
    """Return notes and irregularities of the session as sentences."""
    remarks = list(session.notes)
    if session.station_count > 1:
        remarks.append(f"the instrument stood at {session.station_count} places")
    if session.target:
        remarks.append(f"the target had {session.target + 1} places on the tool")
    if session.skipped:
        stops = ", ".join(str(s + 1) for s in sorted(session.skipped))
        remarks.append(f"left out: stop {stops}")
    doubted = [r.stop + 1 for r in session.accepted if r.doubted]
    if doubted:
        remarks.append(f"kept though doubtful: stop {', '.join(map(str, doubted))}")
    return remarks
