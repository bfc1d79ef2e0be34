"""Texts of a diagnosis' findings, and of the reasons why an effect is not named as a cause."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gapbridge.bridge.document.local_time import clock, day, is_date
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
    Check.SEPARATED: "the flange hardly turns relative to gravity, so that {quantity} may be the "
    "cause as well; poses that turn it by tens of degrees separate them",
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
            return f"{title(fact.term.effect)}: {slip_text(fact)}"
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


def slip_text(slip: Slip) -> str:
    """Return what moved, how far, between which rows, and whether anything else changed."""
    term, joint = slip.term, slip.term.site.joint
    moved = "the target on the tool" if joint is None else f"the zero of joint {joint}"
    if joint is None:
        distance = f"{1e3 * float(np.linalg.norm(term.values[:-1])):.3g} mm"
    else:
        distance = f"{1e3 * term.values[0]:.3g} mrad ({np.degrees(term.values[0]):.3g} deg)"
    besides = "besides the slips" if slip.others else "before and after it"
    more = f"; {besides} nothing else changed" if slip.alone else (
        "; whether anything else changed is open"
    )  # fmt: skip
    if joint is None and slip.between_sessions:
        more += "; if it was remounted between the sessions, add --remounted"
    if joint == 1 and not slip.between_sessions:  # it turns all that is measured about its axis
        more += (
            "; an instrument that was moved there looks the same: if it was, number the rows from "
            "there as another session (column session)"
        )
    if slip.session:
        return f"{moved} moved by {distance}; {slip.session} is the first session that has it{more}"
    return f"{moved} moved by {distance} between {between_text(slip)}{more}"


def between_text(slip: Slip) -> str:
    """Return the last row before a slip and the first row after it."""
    if not slip.timed:
        return f"rows {slip.before:g} and {slip.after:g} of the log, counted without its header"
    start = "" if is_date(slip.first) else " from the start"
    return f"{moment_text(slip, slip.before)} and {moment_text(slip, slip.after)}{start}"


def moment_text(slip: Slip, time: float) -> str:
    """Return a time of the slip's log: of day (with the date if the log has several), s, row."""
    if not slip.timed:
        return f"row {time:g}"
    if is_date(slip.first):
        return clock(time, dated=day(slip.first) != day(slip.last))
    return clock(time - slip.first)


def _parameter(note: ParameterNote) -> str:
    if note.state is ParameterState.ON_BOUND:
        return f"is at its bound ({note.value:g} {note.unit})"
    if note.state is ParameterState.NOMINAL:
        return (
            "is held nominal: its estimate is several times as large as those of similar "
            "parameters and not significant; an unnamed effect may be its cause"
        )
    return "is not identifiable from these data: others can replace it"
