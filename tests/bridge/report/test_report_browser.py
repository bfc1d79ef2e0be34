"""The report in a browser: figures are drawn, without errors and without requests."""

import re
import shutil
from contextlib import contextmanager

import pytest
from on_a_phone import CUT
from patience import PATIENCE, wait_for
from report_cases import CASES, diagnosed

from gapbridge.bridge.report import report_text

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox"]
DRAWN = "document.documentElement.dataset.drawn === 'yes'"
LOCAL = ("file:", "data:", "blob:")

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@contextmanager
def opened(browser, path, width=1200, height=900):
    """Give the page once all of its figures are drawn, and what it asked and complained about."""
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_default_timeout(1e3 * PATIENCE)
    asked, complaints = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.route(lambda url: not url.startswith(LOCAL), lambda route: route.abort())
    page.goto(path.as_uri())
    page.wait_for_function(DRAWN)
    try:
        yield page, asked, complaints
    finally:
        page.close()


@pytest.fixture(scope="module", params=list(CASES))
def report(request, tmp_path_factory):
    return _written(request.param, tmp_path_factory)


@pytest.fixture(scope="module")
def explained(tmp_path_factory):
    return _written("explained", tmp_path_factory)


def _written(name, tmp_path_factory):
    c = diagnosed(name)
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_text(report_text(c.diagnosis, "<b>Cell</b> 7 & co", c.log, c.model), "utf-8")
    return path


def test_every_figure_draws_and_nothing_is_complained_about_or_fetched(browser, report):
    with opened(browser, report) as (page, asked, complaints):
        assert page.locator("figure svg").count() >= 5
        assert page.locator("figure svg rect").count() > 3
        assert page.locator("#how_far svg path.dots").count() >= 1
        assert page.locator("canvas.view[data-drawn=yes]").count() >= 1
        assert complaints == []
        assert [url for url in asked if not url.startswith(LOCAL)] == []
        assert page.locator("h1").inner_text().startswith("<b>Cell</b> 7 & co")
        page.set_viewport_size({"width": 390, "height": 740})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390


def test_the_arm_is_drawn_and_can_be_turned(browser, explained):
    with opened(browser, explained) as (page, _, complaints):
        scene = page.locator("canvas.view").first
        scene.scroll_into_view_if_needed()
        page.wait_for_timeout(300)
        before = scene.screenshot()
        box = scene.bounding_box()
        page.mouse.move(box["x"] + 300, box["y"] + 250)
        page.mouse.down()
        page.mouse.move(box["x"] + 460, box["y"] + 290, steps=5)
        page.mouse.up()
        wait_for(lambda: scene.screenshot() != before, "another view")
        assert complaints == []


def test_a_report_opened_on_a_phone_is_no_wider_than_it(browser, explained):
    with opened(browser, explained, 390, 740) as (page, _, complaints):
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert page.evaluate(CUT) == []
        assert complaints == []


def test_the_wheel_scrolls_the_page_over_the_view_until_it_is_clicked(browser, explained):
    with opened(browser, explained) as (page, _, complaints):
        scene = page.locator("canvas.view").first
        scene.scroll_into_view_if_needed()
        page.wait_for_timeout(300)
        box = scene.bounding_box()
        page.mouse.move(box["x"] + 300, box["y"] + 100)
        before, drawn = page.evaluate("scrollY"), scene.screenshot()
        page.mouse.wheel(0, 80)
        page.wait_for_function("y => scrollY === y", arg=before + 80)
        page.mouse.wheel(0, -80)
        page.wait_for_function("y => scrollY === y", arg=before)
        assert scene.screenshot() == drawn
        page.mouse.click(box["x"] + 300, box["y"] + 100)
        page.mouse.wheel(0, -80)
        wait_for(lambda: scene.screenshot() != drawn, "the view from closer by")
        assert page.evaluate("scrollY") == before
        assert complaints == []


def test_the_reader_chooses_what_the_gap_is_drawn_against(browser, explained):
    with opened(browser, explained) as (page, _, complaints):
        figure = page.locator("#where figure.gallery").first
        shown = figure.locator(".drawings:not([hidden])")
        menu = figure.locator("select").last
        before = shown.inner_html()
        menu.select_option(index=menu.locator("option").count() - 1)
        assert shown.count() == 1
        assert shown.inner_html() != before
        assert complaints == []


def test_a_dark_screen_shows_a_dark_page(browser, explained):
    page = browser.new_page(color_scheme="dark")
    page.set_default_timeout(1e3 * PATIENCE)
    page.goto(explained.as_uri())
    ground = page.evaluate("getComputedStyle(document.querySelector('section')).backgroundColor")
    ink = page.evaluate("getComputedStyle(document.querySelector('svg text')).fill")
    page.close()
    assert max(int(v) for v in re.findall(r"\d+", ground)) < 60
    assert min(int(v) for v in re.findall(r"\d+", ink)) > 140
