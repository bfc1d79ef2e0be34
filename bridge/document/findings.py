"""The words for what a diagnosis reports beside its figures, and for why an effect is no cause."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from gapbridge.bridge.document.log_findings import log_finding_text
from gapbridge.core.diagnosis.causes import Considered, Outcome
from gapbridge.core.diagnosis.finding import (
    Check,
    Fact,
    Finding,
    NotAccused,
    Outliers,
    ParameterNote,
    ParameterState,
    Slip,
    Thinned,
    TooFewRows,
    Withdrawal,
)
from gapbridge.core.log.log_finding import LogFinding

SINCE_1970 = 1e9  # s: from here on a timestamp is a date
DAY = 86400.0  # s
SHOWN = 8  # rows of outliers
WITHDRAWN = {
    Check.CURVED: "its curve cannot be distinguished from a straight line",
    Check.INSIDE_BOUNDS: "its value stands on its bound",
    Check.SIGNIFICANT: "its value may as well be none",
    Check.USUAL_SIZE: "its value is too small to matter",
    Check.NOT_LOCALISED: "one localised shape does as well",
    Check.STABLE_VALUE: "it does not keep its value beside the unknown that is left",
    Check.CONSTANT: "its value is no constant: it goes by {quantity}",
    Check.COMPANION: "no load is declared, and none is accused",
    Check.SEPARATED: "the flange hardly turns against gravity here, so that it may as well be "
    "{quantity}",
    Check.NOT_A_LEVEL: "it steps as {quantity} changes, so that it may as well go by that",
    Check.HELD_OUT_GAIN: "it does not shrink the gap on samples that its fit did not see",
    Check.ALL_ROWS_GAIN: "over all rows the gap does not shrink by it",
}


def finding_text(finding: Finding, *, rows: bool = True, title: Callable[[str], str] = str) -> str:
    """Return a finding as a sentence; without ``rows`` it names no lines of a file.

    ``title``: how a parameter or an effect is named in it.
    """
    if isinstance(finding, LogFinding):
        return log_finding_text(finding)
    return f"{finding.channel}: {_fact(finding.fact, rows, title)}"


def withdrawal_text(reason: Withdrawal) -> str:
    """Return why a term was withdrawn."""
    return WITHDRAWN[reason.failed].format(quantity=reason.quantity)


def considered_text(considered: Considered) -> str:
    """Return why an effect is not accused."""
    if considered.outcome is Outcome.NOT_EXCITED:
        return f"not excited; needs {considered.needs}"
    if considered.withdrawal is None:
        return "does not pay for its parameters beside what is found"
    return withdrawal_text(considered.withdrawal)


def _fact(fact: Fact, rows: bool, title: Callable[[str], str]) -> str:
    match fact:
        case TooFewRows():
            return f"{fact.rows} usable row(s) are too few for a diagnosis"
        case Thinned():
            return (
                f"causes were searched on {fact.searched} of {fact.rows} rows, evenly taken; "
                "fitted and judged on all of them"
            )
        case Outliers():
            return _outliers(fact, rows)
        case NotAccused():
            return _not_accused(fact, title(fact.term.effect))
        case Slip():
            return f"{title(fact.term.effect)}: {_slip(fact)}"
        case ParameterNote():
            return f"{title(fact.name)} {_parameter(fact)}"


def _outliers(outliers: Outliers, rows: bool) -> str:
    text = f"{len(outliers.lines)} outlier(s) excluded"
    if not rows:
        return text
    named = (f"{line} of {session}" if session else str(line) for line, session in outliers.lines)
    shown = ", ".join(list(named)[:SHOWN])
    return f"{text} (row {shown}{', ...' if len(outliers.lines) > SHOWN else ''} of the file)"


def _not_accused(found: NotAccused, effect: str) -> str:
    term = found.term
    joint = f" of joint {term.site.joint}" if term.site.joint else ""
    rest = "; poses not fitted gain by it: a stand-in" if found.stand_in else ""
    return f"{effect}{joint} is not accused: {withdrawal_text(found.reason)}{rest}"


def _slip(slip: Slip) -> str:
    """Return what moved, how far, and between which rows."""
    term, joint = slip.term, slip.term.site.joint
    what = "the target on the tool" if joint is None else f"the zero of joint {joint}"
    if joint is None:
        far = f"{1e3 * float(np.linalg.norm(term.values[:-1])):.3g} mm"
    else:
        far = f"{1e3 * term.values[0]:.3g} mrad ({np.degrees(term.values[0]):.3g} deg)"
    when = f"rows {slip.before:g} and {slip.after:g} of the log"
    if slip.timed:
        dated = slip.before // DAY != slip.after // DAY
        when = f"{clock(slip.before, dated)} and {clock(slip.after, dated)}"
    rest = "; before and after it nothing else changed" if slip.alone else ""
    return f"{what} moved by {far} between {when}{rest}"


def clock(time: float, dated: bool = False) -> str:
    """Return a time of day (UTC), if asked for with its date, of seconds since 1970; else s."""
    if time < SINCE_1970:
        return f"{time:.7g} s"
    return datetime.fromtimestamp(time, tz=UTC).strftime(
        "%Y-%m-%d %H:%M:%S" if dated else "%H:%M:%S"
    )


def _parameter(note: ParameterNote) -> str:
    if note.state is ParameterState.ON_BOUND:
        return f"stands on its bound ({note.value:g} {note.unit})"
    if note.state is ParameterState.NOMINAL:
        return (
            "is held nominal: it came out several times as large as its like, and not "
            "surely; something that is not named may stand behind it"
        )
    return "is not identifiable from these data: others can stand in for it"
