"""The reports in a real browser: nothing is complained about, fetched, or wider than the screen."""

import shutil

import pytest
from calibration_report_cases import calibration, plan, session
from patience import PATIENCE
from short_session_cases import payload, tool, verification

from gapbridge.bridge.calibration.report import (
    CalibrationData,
    ShortSessionData,
    VerificationData,
    write_report,
)

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WRITERS = {
    "calibration": lambda out: write_report(CalibrationData(calibration(), plan(), session()), out),
    "verification": lambda out: write_report(
        VerificationData(verification(moved=True)[0], session(), verification(moved=True)[1]),
        out,
    ),
    "payload": lambda out: write_report(
        ShortSessionData(payload()[0], session(), payload()[1]), out
    ),
    "tool": lambda out: write_report(ShortSessionData(tool()[0], session(), tool()[1]), out),
}
# texts of a drawing that reach beyond its edge
CUT = """[...document.querySelectorAll('svg')].flatMap(svg => {
  const own = svg.getBoundingClientRect();
  return [...svg.querySelectorAll('text')].filter(t => {
    const r = t.getBoundingClientRect();
    return r.left < own.left - 1 || r.right > own.right + 1
      || r.top < own.top - 1 || r.bottom > own.bottom + 1;
  }).map(t => t.textContent);
})"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.mark.parametrize("kind", list(WRITERS))
def test_a_page_fits_desk_and_phone_and_asks_for_nothing(kind, browser, tmp_path):
    path, _ = WRITERS[kind](tmp_path)
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    page.set_default_timeout(1e3 * PATIENCE)
    asked, complaints = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.goto(path.as_uri())
    assert page.locator("h1").inner_text().endswith("Cell 7")
    assert page.locator("svg").count() >= 1
    for width in (1200, 375):
        page.set_viewport_size({"width": width, "height": 800})
        page.wait_for_timeout(150)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(CUT) == []
    page.close()
    assert complaints == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []


def test_the_long_list_opens_when_asked_to(browser, tmp_path):
    path, _ = WRITERS["calibration"](tmp_path)
    page = browser.new_page(viewport={"width": 1200, "height": 900})
    page.set_default_timeout(1e3 * PATIENCE)
    page.goto(path.as_uri())
    rows = page.locator("#readings tbody tr")
    assert rows.count() == len(calibration().readings)
    assert not rows.first.is_visible()
    page.locator("#readings summary").click()
    assert rows.first.is_visible()
    page.close()
