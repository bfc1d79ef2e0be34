"""The demo, step by step: measure, fit, compensate, diagnose, check, report."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console

from gapbridge.bridge.api.uncertainty import provenance_of_fit
from gapbridge.bridge.cell import Cell, load_cell, save_cell
from gapbridge.bridge.demo.hidden import named_causes
from gapbridge.bridge.demo.links import DemoLink, demo_link
from gapbridge.bridge.demo.measurements import Measurements, joined, write_log
from gapbridge.bridge.demo.page import page
from gapbridge.bridge.demo.picture import picture
from gapbridge.bridge.demo.poses import Load, Plan, plan
from gapbridge.bridge.demo.processes import DiagnosisProcess
from gapbridge.bridge.demo.result import Result
from gapbridge.bridge.demo.session import Session
from gapbridge.bridge.demo.terminal import show
from gapbridge.bridge.document.output_file import write_text
from gapbridge.bridge.document.provenance import provenance
from gapbridge.bridge.document.svg import svg_file
from gapbridge.bridge.loop.warm_up import warm_up
from gapbridge.core.arrays import Array
from gapbridge.core.errors import RunError
from gapbridge.core.estimation.identification import identify_compliance
from gapbridge.core.log.log import read_log
from gapbridge.drivers.clock import SYSTEM


@dataclass
class _TestVisits:
    """Measurements of the test visits so far."""

    uncompensated: list[Measurements] = field(default_factory=list)
    compensated: list[Measurements] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)


def run_demo(seed: int, out: Path, link: str = "ur_rtde", console: Console | None = None) -> Result:
    """Calibrate, compensate and diagnose a simulated cell; print the result.

    Writes into ``out``: summary.json, report.html, picture.svg, calibration.csv, the cells before
    and after the fit, and the diagnosis of the calibration log. ``link``: a key of LINKS. Raises
    InputError for an unknown link, RunError where a step fails or the result is wrong.
    """
    kind = demo_link(link)
    console = console or Console()
    begun = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    demo = kind(out, seed)
    warm_up()
    console.print(f"simulated {demo.cell.arm.name} at {demo.host}, its true flexibilities hidden")
    with demo.served():
        result = _job(demo, seed, out, console, begun)
    _write(result[0], result[1], out)
    show(result[0], console)
    console.print(f"results in {out}: report.html, summary.json", highlight=False)
    _require_success(result[0])
    return result[0]


def _job(
    link: DemoLink, seed: int, out: Path, console: Console, begun: float
) -> tuple[Result, str]:
    cell, experiment = link.cell, link.experiment
    session = Session(link, out, console.print, SYSTEM)
    planned = plan(cell.model, link.home, seed, experiment)
    log = _calibrate(link, session, planned, out, console)
    fit = identify_compliance(cell.model, read_log(log, cell.arm.n), cell.metrology)
    # only the flexibilities are kept: the diagnosis has to find the hidden effects
    flexible = cell.model.with_compliance(fit.axial, fit.radial)
    origin = provenance({"log": [log], "cell": [cell.path]})
    written_by = provenance_of_fit(cell, fit, origin, {})
    save_cell(cell, out / "calibrated.yaml", flexible, {"provenance": written_by})
    calibrated = load_cell(out / "calibrated.yaml")
    console.print(
        f"fitted on {fit.samples} poses: gap in space {3**0.5 * fit.gap_rms * 1e3:.3f} mm rms "
        f"before, {3**0.5 * fit.remaining_rms * 1e3:.3f} mm after; only flexibilities are kept"
    )
    visited = _TestVisits()
    explained: list[Measurements] = []
    explained_cell, folder = out / "explained.yaml", out / "diagnosis"
    with DiagnosisProcess(log, calibrated.path, folder, explained_cell) as diagnosis_process:
        for load, visits in zip(experiment.test_loads, planned.test, strict=True):
            _check(cell, calibrated, session, load, visits, visited, console)
        console.print("diagnosing the remaining error of the calibration log")
        diagnosis = diagnosis_process.output()
    document = (folder / "diagnosis.json").read_text(encoding="utf-8")
    causes = named_causes(json.loads(document))
    names = dict.fromkeys(cause.effect for cause in causes)
    console.print(f"causes named by the diagnosis and applied: {', '.join(names) or 'nothing'}")
    corrected = _refit(log, load_cell(explained_cell), out)
    for load, visits in zip(experiment.test_loads, planned.test, strict=True):
        console.print(f"checking {len(visits)} visits with {load.name}, with fit and diagnosis")
        explained.append(session.visit(corrected, load, visits))
    result = Result(
        link=link.name, seed=seed, identification=fit,
        model=calibrated.model, uncompensated=joined(visited.uncompensated),
        compensated=joined(visited.compensated),
        loads=tuple(visited.loads), setpoints_written=session.written, loop=session.figures(),
        duration=time.monotonic() - begun, resolution=link.resolution(),
        test_loads=experiment.test_loads, explained=joined(explained),
        hidden=link.hidden, causes=causes, corrected=corrected.model,
    )  # fmt: skip
    return result, diagnosis


def _refit(log: Path, explained: Cell, out: Path) -> Cell:
    """Fit the flexibilities again with the named causes applied: they biased the first fit."""
    fit = identify_compliance(explained.model, read_log(log, explained.arm.n), explained.metrology)
    flexible = explained.model.with_compliance(fit.axial, fit.radial)
    save_cell(explained, out / "corrected.yaml", flexible)
    return load_cell(out / "corrected.yaml")


def _calibrate(
    link: DemoLink, session: Session, planned: Plan, out: Path, console: Console
) -> Path:
    """Measure poses under each calibration load; returns the path of the log."""
    parts = []
    for load, poses in zip(link.experiment.calibration_loads, planned.calibration, strict=True):
        console.print(f"measuring {len(poses)} poses with {load.name}")
        parts.append(session.visit(link.cell, load, poses))
    write_log(out / "calibration.csv", joined(parts), link.reports_joints)
    return out / "calibration.csv"


def _check(
    cell: Cell, calibrated: Cell, session: Session, load: Load, poses: Array, visited: _TestVisits,
    console: Console,
) -> None:  # fmt: skip
    """Visit test poses without and with compensation, under one load."""
    console.print(f"checking {len(poses)} visits with {load.name}, without compensation")
    visited.uncompensated.append(session.visit(cell, load, poses))
    console.print(f"checking {len(poses)} visits with {load.name}, with compensation")
    visited.compensated.append(session.visit(calibrated, load, poses))
    visited.loads.extend([load.name] * len(poses))


def _write(result: Result, diagnosis: str, out: Path) -> None:
    write_text(out / "summary.json", json.dumps(result.summary(), indent=1) + "\n")
    write_text(out / "picture.svg", svg_file(picture(result)))
    files = {"log": [out / "calibration.csv"], "cell": [out / "calibrated.yaml"]}
    write_text(out / "report.html", page(result, diagnosis, provenance(files)))


def _require_success(result: Result) -> None:
    """Raise RunError where a named cause is wrong or missing, or compensation did not help."""
    before, after = result.error_without, result.error_with
    mismatches = [] if result.hidden is None else result.hidden.mismatches(result.causes)
    if mismatches:
        raise RunError(f"the diagnosis contradicts the hidden truth: {'; '.join(mismatches)}")
    if np.sqrt(np.mean(after**2)) > 0.2 * np.sqrt(np.mean(before**2)):
        raise RunError(
            f"compensation left {np.sqrt(np.mean(after**2)) * 1e3:.3f} mm of "
            f"{np.sqrt(np.mean(before**2)) * 1e3:.3f} mm, expected a fifth at most"
        )
