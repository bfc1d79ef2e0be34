"""Texts of a diagnosis' findings, and of the reasons why an effect is not named as a cause."""

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
    Check.INSIDE_BOUNDS: "its value is at its bound",
    Check.SIGNIFICANT: "its value is not significantly different from zero",
    Check.USUAL_SIZE: "its value is too small to matter",
    Check.NOT_LOCALISED: "a localised shape fits as well",
    Check.STABLE_VALUE: "its value changes when the residual structure is modelled",
    Check.CONSTANT: "its value is not constant: it depends on {quantity}",
    Check.COMPANION: "no load is declared or identified",
    Check.SEPARATED: "the flange hardly turns relative to gravity, so it cannot be separated "
    "from {quantity}",
    Check.NOT_A_LEVEL: "it steps where {quantity} changes, so it may depend on that",
    Check.HELD_OUT_GAIN: "it does not reduce the gap on held-out samples",
    Check.ALL_ROWS_GAIN: "it does not reduce the gap over all rows",
}


def finding_text(finding: Finding, *, rows: bool = True, title: Callable[[str], str] = str) -> str:
    """Return a finding as a sentence; without ``rows`` it names no lines of a file.

    ``title``: function from the name of a parameter or an effect to its title.
    """
    if isinstance(finding, LogFinding):
        return log_finding_text(finding)
    return f"{finding.channel}: {_fact(finding.fact, rows, title)}"


def withdrawal_text(reason: Withdrawal) -> str:
    """Return why a term was withdrawn."""
    return WITHDRAWN[reason.failed].format(quantity=reason.quantity)


def considered_text(considered: Considered) -> str:
    """Return why an effect is not named as a cause."""
    if considered.outcome is Outcome.NOT_EXCITED:
        return f"not excited; needs {considered.needs}"
    if considered.withdrawal is None:
        return "does not improve the fit enough for its parameters"
    return withdrawal_text(considered.withdrawal)


def _fact(fact: Fact, rows: bool, title: Callable[[str], str]) -> str:
    match fact:
        case TooFewRows():
            return f"{fact.rows} usable row(s) are too few for a diagnosis"
        case Thinned():
            return (
                f"causes were searched on {fact.searched} of {fact.rows} rows, drawn evenly; "
                "fitted and judged on all of them"
            )
        case Outliers():
            return _outliers(fact, rows)
        case NotAccused():
            return _not_named(fact, title(fact.term.effect))
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


def _not_named(fact: NotAccused, effect: str) -> str:
    term = fact.term
    joint = f" of joint {term.site.joint}" if term.site.joint else ""
    more = "; it improves held-out poses: a stand-in" if fact.stand_in else ""
    return f"{effect}{joint} is not named as a cause: {withdrawal_text(fact.reason)}{more}"


def _slip(slip: Slip) -> str:
    """Return what moved, how far, and between which rows."""
    term, joint = slip.term, slip.term.site.joint
    moved = "the target on the tool" if joint is None else f"the zero of joint {joint}"
    if joint is None:
        distance = f"{1e3 * float(np.linalg.norm(term.values[:-1])):.3g} mm"
    else:
        distance = f"{1e3 * term.values[0]:.3g} mrad ({np.degrees(term.values[0]):.3g} deg)"
    more = "; before and after it nothing else changed" if slip.alone else ""
    if slip.session:
        return f"{moved} moved by {distance}; {slip.session} is the first session that has it{more}"
    when = f"rows {slip.before:g} and {slip.after:g} of the log"
    if slip.timed:
        dated = slip.before // DAY != slip.after // DAY
        when = f"{clock(slip.before, dated)} and {clock(slip.after, dated)}"
    return f"{moved} moved by {distance} between {when}{more}"


def clock(time: float, dated: bool = False) -> str:
    """Return seconds since 1970 as time of day (UTC), ``dated`` with its date; else seconds."""
    if time < SINCE_1970:
        return f"{time:.7g} s"
    return datetime.fromtimestamp(time, tz=UTC).strftime(
        "%Y-%m-%d %H:%M:%S" if dated else "%H:%M:%S"
    )


def _parameter(note: ParameterNote) -> str:
    if note.state is ParameterState.ON_BOUND:
        return f"is at its bound ({note.value:g} {note.unit})"
    if note.state is ParameterState.NOMINAL:
        return (
            "is held nominal: its estimate is several times as large as those of similar "
            "parameters and not significant; an unnamed effect may be its cause"
        )
    return "is not identifiable from these data: others can replace it"
