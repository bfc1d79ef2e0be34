"""Reports of short sessions: verification, load, tool."""

import pypdfium2
import pytest
from calibration_report_cases import session
from short_session_cases import payload, tool, verification

from gapbridge.bridge.calibration.report import (
    InstrumentFacts,
    ShortSessionData,
    VerificationData,
    write_report,
)
from gapbridge.bridge.document.numbers import estimate_texts, mm


def read(paths):
    """Return the text of the page and the words of the PDF."""
    pages = pypdfium2.PdfDocument(paths[1])
    phrase = "\n".join(page.get_textpage().get_text_bounded() for page in pages)
    return paths[0].read_text("utf-8"), phrase


def test_a_calibration_that_holds_says_so_and_accuses_nothing(tmp_path):
    found, readings = verification(moved=False)
    html, phrase = read(write_report(VerificationData(found, session(), readings), tmp_path))
    for text in (html, phrase):
        assert "Still holds" in text
        assert "Nothing: use the cell as it is." in text
        assert "What may have changed" not in text
        assert mm(found.errors.rms) in text
    assert sorted(p.name for p in tmp_path.iterdir()) == ["verification.html", "verification.pdf"]


def test_a_calibration_that_no_longer_holds_names_what_moved(tmp_path):
    found, readings = verification(moved=True)
    html, phrase = read(write_report(VerificationData(found, session(), readings), tmp_path))
    for text in (html, phrase):
        assert "No longer holds" in text
        assert "Do not rely on this cell" in text
        assert "another zero of joint 3" in text
        assert "joint_offset" not in text


def test_a_verification_without_its_readings_leaves_only_the_angles_out(tmp_path):
    found, _ = verification(moved=True)
    html, _ = read(write_report(VerificationData(found, session()), tmp_path))
    assert all(mm(float(e)) in html for e in found.errors.norm)


@pytest.mark.parametrize(("kind", "unit"), [("payload", "kg"), ("tool", "mm")])
def test_a_short_session_shows_each_number_with_its_interval(kind, unit, tmp_path):
    instrument = InstrumentFacts("on board", kind={"payload": "wrench", "tool": "touch"}[kind])
    facts = session(instrument=instrument)
    if kind == "payload":
        found, nominal = payload()
        paths = write_report(ShortSessionData(found, facts, nominal), tmp_path)
    else:
        found, nominal = tool()
        paths = write_report(ShortSessionData(found, facts, nominal), tmp_path)
    html, phrase = read(paths)

    for estimate in found.estimates:
        value, interval, _, _ = estimate_texts(estimate)
        assert f"<div>{value}</div>" in html
        assert f"<div>{interval}</div>" in html
        assert interval in phrase
    assert unit in phrase
    for text in (html, phrase):
        assert "What to do now" in text
        assert "run CELL --observe" in text
    # an instrument that measures no lengths has no noise in mm
    assert "noise, declared" not in html


def test_an_outlier_reading_of_the_sensor_is_reported(tmp_path):
    found, nominal = payload()
    assert list(found.outliers) == [5]
    html, _ = read(write_report(ShortSessionData(found, session(), nominal), tmp_path))
    assert "Found, see remarks" in html
    assert html.index("See the remarks under") < html.index("Set the same payload")
    assert "Down-weighted as outlier: reading 6." in html
