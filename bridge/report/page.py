"""The page: one HTML file that needs nothing else."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from pathlib import Path

from plotly.offline import get_plotlyjs

from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.section import SECTIONS
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model

FILE = "report.html"


def write_report(
    diagnosis: Diagnosis, cell_name: str, log: Log, model: Model, folder: Path
) -> Path:
    """Write ``report.html`` into a folder and return its path.

    ``model`` is the cell's model as it was diagnosed. Raises RunError where the file cannot be
    written.
    """
    path = folder / FILE
    write_text(path, page(Material(diagnosis, cell_name, log, model)))
    return path


def page(material: Material) -> str:
    """Return the whole page."""
    name = escape(_cell_words(material.cell_name))
    links = "".join(f'<a href="#{key}">{escape(s.title)}</a>' for key, s in SECTIONS.items())
    body = "".join(
        f'<section id="{key}"><h2>{escape(s.title)}</h2>'
        f'<p class="about">{escape(s.about)}</p>{s.write(material)}</section>'
        for key, s in SECTIONS.items()
    )
    log = Path(material.log.path).name
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name} – gap between model and robot</title>"
        # an empty icon keeps browsers from asking for one
        '<link rel="icon" href="data:,">'
        f"<style>{_own('style.css')}</style></head><body>"
        f"<header><h1>{name}: the robot against its model</h1>"
        f"<p>{_arm_words(material.model.arm.name)}, {material.model.arm.n} joints · log "
        f"{escape(log)}, {len(material.log)} rows · Gapbridge</p><nav>{links}</nav></header>"
        f"<main>{body}</main>"
        f"<script>{get_plotlyjs()}</script><script>{_own('page.js')}</script></body></html>\n"
    )


def _cell_words(name: str) -> str:
    """Return a cell's name; of a path to a cell file, the file's own."""
    return Path(name).stem if name.endswith((".yaml", ".yml")) else name


def _arm_words(name: str) -> str:
    return "Arm of DH rows" if name == "dh" else f"Arm {escape(name)}"


def _own(name: str) -> str:
    return files("gapbridge.bridge.report").joinpath(name).read_text(encoding="utf-8")
