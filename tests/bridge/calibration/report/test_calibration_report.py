"""The report of a calibration: one page and one PDF of the same document."""

import os
import re
from pathlib import Path

import pypdfium2
import pytest
from calibration_report_cases import calibration, plan, session
from other_kinds import calibration_of

from gapbridge.bridge.calibration.report import CalibrationData, InstrumentFacts, write_report
from gapbridge.bridge.calibration.report.report import CALIBRATION
from gapbridge.bridge.document.numbers import mm
from gapbridge.core.calibration.observables import OBSERVABLES


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return write_report(
        CalibrationData(calibration(), plan(), session()), tmp_path_factory.mktemp("report")
    )


def text_of(path):
    """Return the words of a PDF."""
    pages = pypdfium2.PdfDocument(path)
    return "\n".join(page.get_textpage().get_text_bounded() for page in pages)


def test_two_files_hold_every_section(written):
    page, paper = written
    assert sorted(p.name for p in page.parent.iterdir()) == ["calibration.html", "calibration.pdf"]
    html, phrase = page.read_text("utf-8"), text_of(paper)
    for section in CALIBRATION:
        assert f'<section id="{section.key}"><h2>{section.title}</h2>' in html
        assert section.title in phrase


def test_the_figures_of_the_calibration_stand_in_both(written):
    page, paper = written
    html, phrase = page.read_text("utf-8"), text_of(paper)
    for errors in (calibration().held_out_before, calibration().held_out_after):
        for figure in (errors.mean, errors.max, errors.rms):
            assert mm(figure) in html
            assert mm(figure) in phrase


def test_names_are_written_as_they_are_and_nothing_of_them_is_markup(written):
    page, paper = written
    assert "Beispiel &amp; Söhne &lt;Werk 2&gt;" in page.read_text("utf-8")
    phrase = text_of(paper)
    assert "Beispiel & Söhne <Werk 2>" in phrase
    assert "M. Łukasik" in phrase


def test_names_in_other_scripts_are_not_lost(tmp_path):
    names = {"customer": "株式会社ロボット", "operator": "Елена Ψαρρά", "serial": "서울 2"}
    facts = session(cell="机器人 3", **names)
    page, paper = write_report(CalibrationData(calibration(), None, facts), tmp_path)
    html, phrase = page.read_text("utf-8"), text_of(paper)
    for name in (*names.values(), "机器人 3"):
        assert name in html
        assert name in phrase


def test_a_name_that_is_not_utf8_is_escaped_in_both(tmp_path):
    facts = session(cell=os.fsdecode(b"c\xff"), folder=Path(os.fsdecode(b"s\xff")))
    page, paper = write_report(CalibrationData(calibration(), None, facts), tmp_path)
    for text in (page.read_text("utf-8"), text_of(paper)):
        assert r"Calibration of c\udcff" in text
        assert r"s\udcff" in text


def test_nothing_is_loaded_from_outside(written):
    html = written[0].read_text("utf-8")
    assert "<script" not in html
    assert not re.findall(r"""(?:src|href)=["']?https?:|url\(""", html)


@pytest.mark.parametrize("kind", list(OBSERVABLES))
def test_every_kind_of_reading_has_its_report(kind, tmp_path):
    c = calibration_of(kind)
    facts = session(instrument=InstrumentFacts("an instrument", kind=kind))
    page, paper = write_report(CalibrationData(c, None, facts), tmp_path)
    html, phrase = page.read_text("utf-8"), text_of(paper)
    assert mm(c.held_out_after.mean) in html
    assert "expanded uncertainty" in phrase
    assert "nan" not in re.sub(r"<[^>]*>", " ", html).split()
    assert "unknown" not in phrase
    shows_places = kind in ("position", "pose")
    assert ("AP before" in phrase) == shows_places
    # no public name of a parameter is left untranslated
    assert not re.findall(r"joint_offset|axial_compliance|tool_frame", phrase)
