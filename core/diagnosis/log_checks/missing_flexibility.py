"""A cell without flexibilities, a soft arm: more causes than a short log can determine one by one.

The catalogue holds every joint's softness, but a search among all effects wants proof for each;
a fit that asks for the softness alone does not.
"""

from __future__ import annotations

from gapbridge.core.diagnosis.criteria import MAX_SHARE_AFTER_FLEXIBILITIES
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.estimation.compliance_fit import flexibilities
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model


def softness_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return a finding on joint flexibilities where the cell names none and a fit of them pays.

    It pays where it halves the gap on poses that it did not see, at least. Frame and tool point
    are fitted along as ``gapbridge fit`` does.
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
