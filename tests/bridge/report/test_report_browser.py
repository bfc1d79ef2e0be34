"""The report in a real browser: figures draw, nothing is complained about, nothing is fetched."""

import shutil
from contextlib import contextmanager

import pytest
from report_cases import CASES, diagnosed

from gapbridge.bridge.report import write_report

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
DRAWN = "[...document.querySelectorAll('.plot')].every(p => p.dataset.drawn === 'yes')"
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
    asked, complaints = [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.route(lambda url: not url.startswith(LOCAL), lambda route: route.abort())
    page.goto(path.as_uri())
    page.wait_for_function(DRAWN, timeout=60_000)
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
    folder = tmp_path_factory.mktemp("report")
    return write_report(c.diagnosis, "<b>Cell</b> 7 & co", c.log, c.model, folder)


def test_every_figure_draws_and_nothing_is_complained_about_or_fetched(browser, report):
    with opened(browser, report) as (page, asked, complaints):
        plots = page.locator(".plot").count()
        assert plots >= 5
        assert page.locator(".plot svg.main-svg").count() >= plots
        assert page.locator(".plot .barlayer .point").count() > 3
        assert page.locator(".plot .scatterlayer .point").count() > 20
        assert page.locator(".plot canvas").count() >= 1
        assert complaints == []
        assert [url for url in asked if not url.startswith(LOCAL)] == []
        assert page.locator("h1").inner_text().startswith("<b>Cell</b> 7 & co")
        page.set_viewport_size({"width": 375, "height": 740})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= 375


def test_the_arm_is_drawn_and_can_be_turned(browser, explained):
    with opened(browser, explained) as (page, _, complaints):
        scene = page.locator(".plot:has(canvas)").first
        scene.scroll_into_view_if_needed()
        page.wait_for_timeout(300)
        before = scene.screenshot()
        box = scene.bounding_box()
        page.mouse.move(box["x"] + 300, box["y"] + 250)
        page.mouse.down()
        page.mouse.move(box["x"] + 460, box["y"] + 290, steps=5)
        page.mouse.up()
        page.wait_for_timeout(500)
        assert scene.screenshot() != before
        assert complaints == []


def test_a_report_opened_on_a_phone_is_no_wider_than_it(browser, explained):
    with opened(browser, explained, 375, 740) as (page, _, complaints):
        assert page.evaluate("document.documentElement.scrollWidth") <= 375
        assert complaints == []


def test_the_reader_chooses_what_the_gap_is_drawn_against(browser, explained):
    with opened(browser, explained) as (page, _, complaints):
        figure = page.locator("#where figure:has(select[data-axis=x])").first
        menu = figure.locator("select[data-axis=x]")
        before = figure.locator(".xtitle").text_content()
        menu.select_option(index=menu.locator("option").count() - 1)
        page.wait_for_timeout(300)
        assert figure.locator(".xtitle").text_content() != before
        assert complaints == []
