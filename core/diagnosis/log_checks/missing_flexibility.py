"""Log check for a rigid cell of a compliant arm: more causes than a short log can identify singly.

A search requires each joint's flexibility to be significant; a fit of all flexibilities alone does
not.
"""

from __future__ import annotations

from gapbridge.core.diagnosis.criteria import MAX_SHARE_AFTER_FLEXIBILITIES
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.estimation.flexibilities import flexibilities
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model


def flexibility_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return a finding if the cell has no joint flexibilities and a fit of them halves the gap.

    The gap is that of held-out poses. Frame and tool point are fitted too, as in ``gapbridge fit``.
    """
    if flexibilities(model).any():
        return []
    try:
        fitted = identify_compliance(model, log, metrology)
    except GapbridgeError:
        return []
    before, after = fitted.gap_rms_held_out, fitted.remaining_rms_held_out
    if not after < MAX_SHARE_AFTER_FLEXIBILITIES * before:
        return []
    values = int(fitted.identifiable.sum()), before, after
    return [LogFinding(LogCheck.MISSING_FLEXIBILITY, values)]
