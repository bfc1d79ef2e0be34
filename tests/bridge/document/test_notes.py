"""Texts of notes: every reason has its own, which uses all values of the note."""

from __future__ import annotations

import pytest

from gapbridge.bridge.document.notes import TEXTS, note_text
from gapbridge.core.notes import Note, Reason
from gapbridge.core.planning.candidates import RejectedPoses

SAMPLES = {
    Note(Reason.SUM_KNOWN, ("a_1", "b_2", 0.991)):
        "a_1 and b_2: mostly their sum is known (correlation +0.991)",
    Note(Reason.ACTS_LIKE, ("a_1", ((1.0, "b_2"), (-0.5, "c_3")))):
        "a_1: not identifiable alone from these data, it acts like +1.00 b_2 -0.50 c_3; their "
        "sum is written there, this one stays at the model's value",
    Note(Reason.REDUNDANT, ("a_1", ("b_2", "c_3"))):
        "a_1: the same as b_2 and c_3; its effect is included there",
    Note(Reason.REDUNDANT_WITH_PLACE, ("a_1", ())):
        "a_1: the same as the place of instrument or target; its effect is included there",
    Note(Reason.EFFECTS_MISSING, ((("backlash_3", 0.42),),)):
        "effects to add, with the share of the remaining error that each removes on held-out "
        "poses: backlash_3 (42 %)",
    Note(Reason.IDLE_LOADS, ((0.01, 2.0),)):
        "loads that add no information and need not be attached: 0.01 kg, 2 kg",
    Note(Reason.DETOURS, (tuple((i, i + 1) for i in range(1, 11)),)):
        "no straight path in joint space, make a detour: stops 1 to 2, 2 to 3, 3 to 4, 4 to 5, "
        "5 to 6, 6 to 7, 7 to 8, 8 to 9 and 2 more",
    Note(Reason.FEW_POSES, (RejectedPoses(200, (("BOX", 2, 100), ("FLOOR", 0, 50))),)):
        "few poses to choose from: of 200 random poses 50 % come into keep-out box 2, 25 % come "
        "below the floor",
}  # fmt: skip


@pytest.mark.parametrize("note", SAMPLES, ids=lambda note: note.reason.name)
def test_a_note_reads_as_a_sentence(note: Note) -> None:
    assert note_text(note) == SAMPLES[note]


def test_every_reason_has_its_words() -> None:
    assert set(TEXTS) == set(Reason)


@pytest.mark.parametrize(
    ("reason", "values", "option"),
    [
        (Reason.EFFORT_UNKNOWN, ("/joint_states",), "--effort-is-torque"),
        (Reason.WRENCH_UNKNOWN, ("/wrench", ("ft_raw_wrench",)), "--wrench ft_raw_wrench"),
        (Reason.POSE_UNNAMED, ("/pose",), "--topic pose=TOPIC"),
    ],
)
def test_what_a_source_leaves_out_is_taken_by_convert_which_alone_has_the_option(
    reason: Reason, values: tuple[object, ...], option: str
) -> None:
    text = note_text(Note(reason, values))
    assert "gapbridge convert takes" in text
    assert option in text
