"""A report that can be signed: number, version, hash, accuracy asked for, pages counted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pypdfium2
import pytest
from calibration_report_cases import calibration, plan, session

from gapbridge.bridge.calibration.report import CalibrationData, write_report
from gapbridge.core.calibration.result import Errors
from gapbridge.core.notes import Note, Reason

FACTS = {"number": "GB-20261121-0912-1a2b3c4d", "version": "9.8.7", "cell_sha256": "ab" * 32}


def page(folder: Path, accuracy: float | None, **changed: object) -> str:
    found = replace(calibration(), **changed)
    facts = session(**FACTS, accuracy=accuracy)
    return write_report(CalibrationData(found, plan(), facts), folder)[0].read_text(
        encoding="utf-8"
    )


def test_number_version_hash_certificate_and_room_to_sign_stand_in_it(tmp_path: Path) -> None:
    text = page(tmp_path, None)
    for found in (FACTS["number"], "Gapbridge 9.8.7", "abababab " * 7 + "abababab", "no. 88120"):
        assert found in text
    assert "released by" in text
    assert "Required: " not in text


@pytest.mark.parametrize(("accuracy", "word"), [(1e-3, "Pass"), (1e-5, "Fail")])
def test_the_accuracy_asked_for_is_met_or_not(tmp_path: Path, accuracy: float, word: str) -> None:
    text = page(tmp_path, accuracy)
    assert f">{word}</span>" in text
    assert f"held-out pose above {accuracy * 1e3:.3f} mm" in text
    steps = text.split("What to do now")[1].split("</ul>")[0]
    assert ("The required accuracy is not met" in steps) == (word == "Fail")
    assert "gapbridge calibrate CELL --verify" in steps


def test_a_calibration_that_improves_nothing_is_not_to_be_used(tmp_path: Path) -> None:
    c = calibration()
    text = page(tmp_path, None, held_out_after=c.held_out_before)
    steps = text.split("What to do now")[1].split("</ul>")[0]
    assert "Do not use this calibration" in steps
    assert "gapbridge run" not in steps


def test_fewer_than_eight_poses_decide_nothing(tmp_path: Path) -> None:
    c = calibration()
    few = np.isin(c.readings.pose[c.held_out_after.rows], np.arange(40, 47))

    def part(errors: Errors) -> Errors:
        return Errors(errors.vector[few], errors.rows[few])

    text = page(
        tmp_path, 1e-3, held_out_after=part(c.held_out_after),
        held_out_before=part(c.held_out_before), tcp_std=c.tcp_std[few],
    )  # fmt: skip
    assert ">Not decided</span>" in text
    assert "7 such poses were measured, expected 8 or more" in text


@pytest.mark.slow
def test_the_residual_is_described_alike_in_every_section(tmp_path: Path) -> None:
    c = calibration(True)
    left = Note(Reason.EFFECTS_MISSING, ((("transmission_error_2", 0.9),),))
    changed = {
        "diagnosis": c.diagnosis, "complete": False, "missing_effects": ("transmission_error_2",),
        "remaining": left,
    }  # fmt: skip
    text = page(tmp_path, None, **changed)
    section = text[text.index('id="residual"') : text.index('id="poses"')]
    assert "Effects to add, with the share" in section
    assert "90 %" in section
    assert "no effect of the catalogue explains" not in section.lower()
    assert "no gap" not in section.lower()


def test_every_page_says_how_many_there_are(tmp_path: Path) -> None:
    _, paper = write_report(CalibrationData(calibration(), plan(), session(**FACTS)), tmp_path)
    pages = pypdfium2.PdfDocument(str(paper))
    ends = [p.get_textpage().get_text_bounded().strip().split("\n")[-1] for p in pages]
    assert ends == [f"page {i} of {len(pages)}" for i in range(1, len(pages) + 1)]
