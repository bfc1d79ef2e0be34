"""Consistency of a cell with a log: whether the measured poses are those of the cell's arm."""

from __future__ import annotations

from pathlib import Path

from gapbridge.bridge.cell.cell import Cell
from gapbridge.bridge.cell.opened_log import open_log
from gapbridge.bridge.cell.plausibility import Findings
from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.diagnosis.channels.position import session_model
from gapbridge.core.diagnosis.log_checks.frames import frame_findings
from gapbridge.core.diagnosis.log_checks.units_and_clocks import findings
from gapbridge.core.errors import LogError
from gapbridge.core.log.columns import did_you_mean
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.sessions import sessions_in, with_sessions

MEASURED = "measured_position"


def log_findings(cell: Cell, path: Path) -> Findings:
    """Return how measured poses contradict the cell's arm (errors), and anomalies (warnings).

    Raises InputError if the log cannot be used.
    """
    log = with_sessions(open_log(path, cell), cell.model)
    if not log.has(MEASURED):
        hint = did_you_mean(log.unknown, [MEASURED], log.n)
        raise LogError(
            f"{path}: columns {MEASURED}_0..2: not found, expected them: without measured "
            f"positions the arm cannot be checked{hint}"
        )
    log.require("actual_q", "target_q")
    log.loads()
    errors = [log_finding_text(finding) for finding in pose_findings(cell, log)]
    anomalies: dict[str, None] = {}  # in order, without duplicates
    for part in sessions_in(log):
        unit_findings = findings(part, cell.model, cell.metrology)
        anomalies |= dict.fromkeys(log_finding_text(finding) for finding in unit_findings)
    return Findings(
        [f"{cell.path} with {path}: {text}" for text in errors],
        [f"{path}: {text}" for text in anomalies if text not in errors],
    )


def pose_findings(cell: Cell, log: Log, metrology: Metrology | None = None) -> list[LogFinding]:
    """Return how measured poses contradict the cell's arm, without duplicates.

    ``metrology`` None: the cell's.
    """
    metrology = metrology or cell.metrology
    found: dict[LogFinding, None] = {}
    for part in sessions_in(log):
        model = session_model(cell.model, part, metrology)
        found |= dict.fromkeys(frame_findings(model, part, metrology))
    return list(found)


def pose_warnings(cell: Cell, log: Log, metrology: Metrology) -> list[str]:
    """Return how the measured poses contradict the cell, as texts."""
    return [log_finding_text(finding) for finding in pose_findings(cell, log, metrology)]
