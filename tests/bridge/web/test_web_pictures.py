"""Pictures of the status page for the documentation, made of a daemon on a simulated robot.

GAPBRIDGE_PICTURES=1 keeps them in docs/pictures, after a minute of history; else they are made of
whatever the daemon is doing, and thrown away.
"""

import os
import shutil
import time
from pathlib import Path

import pytest
from daemon_cell import Robot
from patience import PATIENCE
from watched_daemon import Watched

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
PICTURES = Path(__file__).parents[3] / "docs" / "pictures"
KEPT = bool(os.environ.get("GAPBRIDGE_PICTURES"))
WINDOWS = {
    "status-page": (1280, 900, "light"),
    "status-page-dark": (1280, 900, "dark"),
    "status-page-phone": (390, 844, "light"),
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine"),
]


def test_pictures_of_the_status_page(tmp_path):
    folder = PICTURES if KEPT else tmp_path
    folder.mkdir(exist_ok=True)
    cell = tmp_path / "ur10e_press"
    cell.mkdir()
    with Robot(cell) as robot, playwright.sync_playwright() as started:
        daemon = Watched(robot, swing=0.12 if KEPT else 0.009)
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        try:
            daemon.wait("observing")
            pages = {
                name: _opened(browser, daemon.url, *window) for name, window in WINDOWS.items()
            }
            time.sleep(8 if KEPT else 1)
            daemon.arm()
            time.sleep(35 if KEPT else 1)
            for name, (page, complaints) in pages.items():
                path = folder / f"{name}.png"
                for _ in range(10):
                    page.screenshot(path=path, full_page=True)
                    if not KEPT or "Compensating" in page.inner_text("main"):
                        break
                    daemon.arm()  # a busy machine stopped it
                    time.sleep(20)
                assert not KEPT or daemon.status()["now"]["state"] == "compensating"
                assert complaints == []
                assert path.stat().st_size > 20_000
                assert page.evaluate("document.documentElement.scrollWidth") <= WINDOWS[name][0]
        finally:
            daemon.end()
            browser.close()


def _opened(browser, url, width, height, theme):
    """Return a live page of a size and theme, and what it complains of as long as it is open."""
    context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=theme)
    page = context.new_page()
    page.set_default_timeout(1e3 * PATIENCE)
    complaints = []
    page.on("pageerror", lambda e: complaints.append(str(e)))
    page.on("console", lambda m: complaints.append(m.text) if m.type == "error" else None)
    page.goto(url)
    page.wait_for_selector('body[data-connection="live"]')
    return page, complaints
