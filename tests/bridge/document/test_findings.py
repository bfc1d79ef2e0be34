"""Texts of findings: every check has its own, and each text contains the numbers of its fact."""

from __future__ import annotations

import pytest

from gapbridge.bridge.document.findings import (
    WITHDRAWN,
    considered_text,
    finding_text,
    withdrawal_text,
)
from gapbridge.core.diagnosis.causes import Considered, Outcome
from gapbridge.core.diagnosis.finding import (
    ChannelFinding,
    Check,
    NotAccused,
    Outliers,
    ParameterNote,
    ParameterState,
    Slip,
    Thinned,
    TooFewRows,
    Withdrawal,
)
from gapbridge.core.effects import Site, Term

PLAY = Term("backlash", Site(2), (9e-4,))
BOUND = Withdrawal(Check.INSIDE_BOUNDS)
EVENING = 1.7e9  # 2023-11-14 22:13:20 UTC


def slipped(
    before: float, after: float, last: float | None = None, timed: bool = True, alone: bool = True,
    **more,
) -> Slip:  # fmt: skip
    """Return a slip of joint 3 between two rows of a log that begins with the first of them."""
    term = Term("joint_slip", Site(3), (2e-3, (before + after) / 2))
    return Slip(term, before, after, before, last or after, timed, alone, **more)


def test_every_check_has_a_sentence_of_its_own() -> None:
    assert set(WITHDRAWN) == set(Check)
    assert len(set(WITHDRAWN.values())) == len(Check)


def test_a_value_that_is_not_constant_names_the_quantity() -> None:
    text = withdrawal_text(Withdrawal(Check.CONSTANT, "actual_q_2"))
    assert text == "its value is not constant: it depends on actual_q_2"


@pytest.mark.parametrize(
    ("fact", "text"),
    [
        (TooFewRows(3), "3 usable row(s) are too few for a diagnosis"),
        (Thinned(60, 200), "causes were searched on 60 of 200 rows, drawn evenly; fitted and "
                           "judged on all of them"),
        (Outliers(((13, ""), (42, ""))), "2 outlier(s) excluded (row 13, 42 of the file)"),
        (Outliers(tuple((row, "b.csv") for row in range(2, 11))),
         "9 outlier(s) excluded (row 2 of b.csv, 3 of b.csv, 4 of b.csv, 5 of b.csv, 6 of b.csv, "
         "7 of b.csv, 8 of b.csv, 9 of b.csv, ... of the file)"),
        (NotAccused(PLAY, BOUND, stand_in=False),
         "backlash of joint 2 is not named as a cause: its value is at its bound"),
        (NotAccused(Term("tool_frame", Site(), (1e-3,)), BOUND, stand_in=True),
         "tool_frame is not named as a cause: its value is at its bound; it improves held-out "
         "poses: a stand-in"),
        (slipped(EVENING, EVENING + 40),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg) between 22:13:20 and "
         "22:14:00; before and after it nothing else changed"),
        (slipped(EVENING, EVENING + 86400, alone=False),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg) between 2023-11-14 22:13:20 "
         "and 2023-11-15 22:13:20; whether anything else changed is open"),
        (slipped(EVENING, EVENING + 40, last=EVENING + 9e4),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg) between 2023-11-14 22:13:20 "
         "and 2023-11-14 22:14:00; before and after it nothing else changed"),
        (slipped(42, 43, timed=False, alone=False),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg) between rows 42 and 43 of "
         "the log, counted without its header; whether anything else changed is open"),
        (slipped(42, 43, others=1, session="b.csv"),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg); b.csv is the first session "
         "that has it; besides the slips nothing else changed"),
        (Slip(Term("target_slip", Site(), (3e-4, 4e-4, 0.0, 107.5)), 107, 108, 100, 120, True,
              alone=True),
         "target_slip: the target on the tool moved by 0.5 mm between 7 s and 8 s from the start; "
         "before and after it nothing else changed"),
        (Slip(Term("target_slip", Site(), (3e-4, 4e-4, 0.0, 107.5)), 107, 108, 100, 120, True,
              alone=True, between_sessions=True),
         "target_slip: the target on the tool moved by 0.5 mm between 7 s and 8 s from the start; "
         "before and after it nothing else changed; if it was remounted between the sessions, add "
         "--remounted"),
        (slipped(42, 43, session="b.csv", between_sessions=True),
         "joint_slip: the zero of joint 3 moved by 2 mrad (0.115 deg); b.csv is the first session "
         "that has it; before and after it nothing else changed"),
        (Slip(Term("joint_slip", Site(1), (2e-3, 107.5)), 107, 108, 100, 120, True, alone=True),
         "joint_slip: the zero of joint 1 moved by 2 mrad (0.115 deg) between 7 s and 8 s from the "
         "start; before and after it nothing else changed; an instrument that was moved there "
         "looks the same: if it was, number the rows from there as another session (column "
         "session)"),
        (Slip(Term("joint_slip", Site(1), (2e-3, 107.5)), 107, 108, 100, 120, True, alone=True,
              between_sessions=True),
         "joint_slip: the zero of joint 1 moved by 2 mrad (0.115 deg) between 7 s and 8 s from the "
         "start; before and after it nothing else changed"),
        (ParameterNote(ParameterState.ON_BOUND, "backlash_2", 0.0, "rad"),
         "backlash_2 is at its bound (0 rad)"),
        (ParameterNote(ParameterState.NOMINAL, "link_geometry_5_alpha", 0.0, "rad"),
         "link_geometry_5_alpha is held nominal: its estimate is several times as large as those "
         "of similar parameters and not significant; an unnamed effect may be its cause"),
        (ParameterNote(ParameterState.NOT_IDENTIFIABLE, "backlash_2", 1e-4, "rad"),
         "backlash_2 is not identifiable from these data: others can replace it"),
    ],
)  # fmt: skip
def test_a_fact_is_worded_with_its_numbers(fact, text) -> None:
    assert finding_text(ChannelFinding("position", fact)) == f"position: {text}"


def test_without_rows_no_line_of_a_file_is_named() -> None:
    finding = ChannelFinding("position", Outliers(((13, ""), (42, ""))))
    assert finding_text(finding, rows=False) == "position: 2 outlier(s) excluded"


@pytest.mark.parametrize(
    ("considered", "text"),
    [
        (Considered("payload", None, 0.0, Outcome.NOT_EXCITED, "a payload"),
         "not excited; needs a payload"),
        (Considered("payload", 0.1, 0.2, Outcome.NOT_NEEDED),
         "does not improve the fit enough for its parameters"),
        (Considered("backlash", 0.1, 0.2, Outcome.WITHDRAWN, withdrawal=BOUND),
         "its value is at its bound"),
    ],
)  # fmt: skip
def test_why_an_effect_is_no_cause(considered, text) -> None:
    assert considered_text(considered) == text
