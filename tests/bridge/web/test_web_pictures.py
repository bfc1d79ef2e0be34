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
            time.sleep(8 if KEPT else 1)
            daemon.arm()
            time.sleep(35 if KEPT else 1)
            for name, (width, height, theme) in WINDOWS.items():
                context = browser.new_context(
                    viewport={"width": width, "height": height}, color_scheme=theme
                )
                page = context.new_page()
                complaints = []
                page.on("pageerror", lambda e, seen=complaints: seen.append(str(e)))
                page.on(
                    "console",
                    lambda m, seen=complaints: seen.append(m.text) if m.type == "error" else None,
                )
                page.goto(daemon.url)
                page.wait_for_selector('body[data-connection="live"]', timeout=20_000)
                page.wait_for_timeout(2500)
                path = folder / f"{name}.png"
                page.screenshot(path=path, full_page=True)
                assert not KEPT or daemon.status()["now"]["state"] == "compensating"
                assert complaints == []
                assert path.stat().st_size > 20_000
                assert page.evaluate("document.documentElement.scrollWidth") <= width
                context.close()
        finally:
            daemon.end()
            browser.close()
