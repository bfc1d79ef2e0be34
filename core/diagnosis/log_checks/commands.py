"""Log check for commands in another order of joints than the encoders'."""

from __future__ import annotations

import numpy as np

from gapbridge.core.diagnosis.criteria import MAX_SHARE_WITH_OTHER_SIGN
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding

MAX_ROWS = 200  # that are checked, evenly spaced
MIN_ROWS = 6
MIN_AWAY = 0.1  # rad from the encoder: servos of arms follow more closely


def command_findings(log: Log) -> list[LogFinding]:
    """Return the finding on columns ``target_q`` that follow other joints than their own."""
    target, q = log.get("target_q"), log.get("actual_q")
    if target is None or q is None:
        return []
    rows = np.flatnonzero(np.isfinite(target).all(axis=1) & np.isfinite(q).all(axis=1))
    if len(rows) < MIN_ROWS:
        return []
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, MAX_ROWS).astype(int))]
    # (n, n) median distance of each joint from each column
    away = np.median(np.abs(q[rows, :, None] - target[rows, None, :]), axis=0)
    order, own = away.argmin(axis=1), np.diag(away)
    moved = np.flatnonzero(order != np.arange(len(order)))
    if len(set(order.tolist())) < len(order) or not len(moved):
        return []
    if (own[moved] < MIN_AWAY).any():
        return []
    if (away.min(axis=1)[moved] > MAX_SHARE_WITH_OTHER_SIGN * own[moved]).any():
        return []
    return [
        LogFinding(LogCheck.COMMAND_ORDER, (tuple((int(i) + 1, int(order[i])) for i in moved),))
    ]
