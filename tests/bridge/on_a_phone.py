"""A written page on a phone's screen, in a real browser."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from patience import PATIENCE

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WIDTH = 390
# What leaves the screen and cannot be scrolled to, what its own box cuts, text out of a drawing.
CUT = """() => [...document.querySelectorAll('body *')].filter(e => {
  const r = e.getBoundingClientRect(), style = getComputedStyle(e);
  if (!r.width || !r.height) return false;
  if (e.tagName === 'text') {
    const own = e.ownerSVGElement.getBoundingClientRect();
    if (r.left < own.left - 1 || r.right > own.right + 1) return true;
  }
  const hidden = ['hidden', 'clip'].includes(style.overflowX) && e.clientWidth > 5;
  if (hidden && e.scrollWidth > e.clientWidth + 1) return true;
  for (let up = e.parentElement; up; up = up.parentElement)
    if (['auto', 'scroll'].includes(getComputedStyle(up).overflowX)) return false;
  return r.right > innerWidth + 1;
}).map(e => `${e.tagName} ${e.textContent.trim().slice(0, 60)}`)"""
# Text of a drawing that is too small to read, as large as the screen shows it.
SMALL = """() => [...document.querySelectorAll('svg text')].filter(e => {
  const own = e.ownerSVGElement, shown = own.getBoundingClientRect().width;
  const size = parseFloat(getComputedStyle(e).fontSize) * shown / own.viewBox.baseVal.width;
  return shown && size < 6.9;
}).map(e => `too small: ${e.textContent}`)"""
DARK = """() => getComputedStyle(document.body).backgroundColor.match(/[0-9]+/g).slice(0, 3)
  .reduce((sum, part) => sum + Number(part), 0) < 200"""


def faults_on_a_phone(playwright: Any, path: Path) -> list[str]:
    """Return what is cut off on a phone's screen, and whether a dark one is answered in kind."""
    found: list[str] = []
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for scheme in ("light", "dark"):
            page = browser.new_page(viewport={"width": WIDTH, "height": 844}, color_scheme=scheme)
            page.set_default_timeout(1e3 * PATIENCE)
            page.goto(path.as_uri())
            page.wait_for_timeout(500)
            if page.evaluate("document.documentElement.scrollWidth") > WIDTH:
                found.append(f"{scheme}: wider than the screen")
            faults = [*page.evaluate(CUT), *page.evaluate(SMALL)]
            found += [f"{scheme}: {what}" for what in faults]
            if page.evaluate(DARK) != (scheme == "dark"):
                found.append(f"{scheme}: another ground")
        browser.close()
    return found
