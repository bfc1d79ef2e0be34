"""Beside other programs, on the same data: ``python -m benchmarks.calibration.peers``.

Gapbridge, a plain scipy fit of the DH table, and FIGAROH (``--figaroh PYTHON``: a Python of its own
that has it) calibrate from the same rows and are judged on the same held-out rows: the rms of one
coordinate, and the CPU time. Simulated sessions with loads, and the measured sets that suit.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import click
import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from benchmarks.blind.arms import ARMS
from benchmarks.blind.mechanics import Array
from benchmarks.calibration import laid_out
from benchmarks.calibration.dh_fit import fit_dh
from benchmarks.calibration.drawings import model_of, real_arm
from benchmarks.calibration.urdf import urdf_of
from gapbridge.bridge.cell import load_cell
from gapbridge.core.calibration.fit import evaluate_fit, fit_session
from gapbridge.core.calibration.identifiability import identifiable_parameters
from gapbridge.core.calibration.observables import make_observable
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.loads import Loads
from gapbridge.core.log.log import read_log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

MEASURED = ("tsinghua_ur5_grid", "ipa_ur10_b", "barrett_wam_grid")
ALONE = ("cobot10", "seven14")  # under one load as well
MOST = 200  # rows to fit of a measured set
PATIENCE = 120.0  # s, for one program on one set


@dataclass(frozen=True)
class DataSet:
    """Rows to fit and rows to judge by."""

    name: str
    model: Model
    readings: Readings
    floor: float  # m, instrument and arm, one coordinate; nan: unknown


@dataclass(frozen=True)
class Row:
    """What one program did on one data set."""

    data: str
    program: str
    before: float  # m, rms of one coordinate, held out, nominal arm with its frame fitted
    held_out: float  # m
    floor: float  # m
    seconds: float  # of CPU, whatever else the machine does
    parameters: int
    note: str = ""


def simulated(arm: str, seed: int, *, loads: bool = True) -> DataSet:
    """Return a simulated session, every parameter of geometry and softness drawn.

    ``loads``: three, else the lightest alone, with as many poses.
    """
    rng, kind = np.random.default_rng([seed, 5]), ARMS[arm]
    layout = laid_out.Layout(held_out=60) if loads else laid_out.Layout(poses=60, held_out=180)
    model = model_of(real_arm(kind))
    names = [n for n in Parameters.of_effects(model, DEFAULT).names if "tool_frame_r" not in n]
    real, laid = (
        laid_out.arm_with(kind, laid_out.draw_values(kind, names, rng)),
        laid_out.lay_out(kind, layout, rng),
    )
    instrument = laid_out.instrument_for(kind, layout, rng)
    readings = laid_out.readings_of(real, laid, instrument, rng)
    exact = laid_out.readings_of(real, laid, instrument, None)
    kept = np.flatnonzero(readings.load >= 0 if loads else readings.load == 0)
    readings, exact = readings[kept], exact[kept]
    floor = float(np.sqrt(np.mean((readings.value - exact.value)[readings.held_out] ** 2)))
    name = f"simulated {arm}, {'three loads' if loads else 'one load'}"
    return DataSet(name, model, readings, floor)


def measured(name: str, folder: Path) -> DataSet:
    """Return a measured set, every third row held out."""
    cell = load_cell(folder / name / "cell.yaml")
    log = read_log(folder / name / "log.csv", cell.arm.n)
    good = np.flatnonzero(np.isfinite(log.require("measured_position")).all(axis=1))
    step = max(len(good) // (3 * MOST // 2), 1)
    rows = good[::step]
    count = len(rows)
    zeros = np.zeros(count, dtype=np.int64)
    readings = Readings(
        "position", log.require("actual_q")[rows], log.require("measured_position")[rows],
        np.full(count, np.nan), Loads(), zeros, zeros, zeros, np.arange(count) % 3 == 2,
        np.arange(count),
    )  # fmt: skip
    return DataSet(name, cell.model, readings, float("nan"))


def by_gapbridge(data: DataSet) -> tuple[float, float, int, str]:
    """Return held-out rms, seconds, number of parameters, and what it says of the result."""
    begun = time.process_time()
    how = make_observable("position")
    bends = data.readings.loads.payload_mass is not None or bool(data.model.arm.mass.any())
    effects = DEFAULT if bends else ("tool_frame", "joint_offset", "link_geometry")
    parameters = identifiable_parameters(data.model, effects, observable=how)
    found = evaluate_fit(
        data.model, fit_session(data.readings, parameters, Metrology()), diagnose=False
    )
    seconds = time.process_time() - begun
    return _coordinate(found.held_out_after.vector), seconds, len(parameters), found.verdict


def by_scipy(data: DataSet) -> tuple[float, float, int, str]:
    """Return the same for scipy's least squares on the DH table, tool and frame along."""
    fitted = ~data.readings.held_out
    begun = time.process_time()
    fit = fit_dh(data.model, data.readings.q[fitted], data.readings.value[fitted])
    seconds = time.process_time() - begun
    away = data.readings[data.readings.held_out]
    return _coordinate(away.value - fit.predict(away.q)), seconds, fit.count, ""


def by_figaroh(data: DataSet, python: str, patience: float) -> tuple[float, float, int, str]:
    """Return the same for FIGAROH's full_params with its joint elasticity where links weigh."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _figaroh_files(data, folder)
        script = Path(__file__).with_name("figaroh_fit.py")
        try:
            done = subprocess.run(
                [python, str(script), str(folder)], capture_output=True, text=True,
                timeout=patience, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            return float("nan"), float("nan"), 0, f"failed: no result within {patience:g} s"
    lines = [x for x in done.stdout.splitlines() if x.startswith("RESULT ")]
    if not lines:
        last = (done.stderr or done.stdout).strip().splitlines()[-1:]
        return float("nan"), float("nan"), 0, f"failed: {' '.join(last)}"
    reported = json.loads(lines[-1][7:])
    return reported["held_out_rms"], reported["seconds"], reported["parameters"], ""


def _figaroh_files(data: DataSet, folder: Path) -> None:
    """Write what FIGAROH reads: URDF, configuration, rows to fit and to judge by."""
    arm, readings = data.model.arm, data.readings
    (folder / "robot.urdf").write_text(urdf_of(arm), encoding="utf-8")
    joints = [f"joint_{i + 1}" for i in range(arm.n)]
    for part, rows in (("train", ~readings.held_out), ("held_out", readings.held_out)):
        table = np.hstack([readings.value[rows], readings.q[rows]])
        head = ",".join(["x1", "y1", "z1", *joints])
        np.savetxt(folder / f"{part}.csv", table, delimiter=",", header=head, comments="")
    poses = {"base_pose": [0.0] * 6, "tool_pose": [0.0] * 6}
    task = {
        "enabled": True,
        "type": "kinematic_calibration",
        "joints": {"active_joints": joints},
        "kinematics": {"base_frame": "universe", "tool_frame": "flange"},
        "parameters": {
            "calibration_level": "full_params",
            "include_non_geometric": bool(arm.mass.any()),
        },
        "measurements": {
            "markers": [{"ref_joint": joints[-1], "measurable_dof": [True] * 3 + [False] * 3}],
            "poses": poses,
        },
        "data": {
            "source_file": str(folder / "train.csv"),
            "validation_data_file": str(folder / "held_out.csv"),
            "number_of_samples": int((~readings.held_out).sum()),
        },
    }
    config = {
        "robot": {"name": "arm", "properties": {"joints": {"active_joints": joints}}},
        "tasks": {"calibration": task},
    }
    (folder / "figaroh.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")


def nominal(data: DataSet) -> float:
    """Return the held-out rms of one coordinate of the nominal arm, its frame fitted."""
    how = make_observable("position")
    fitted, away = data.readings[~data.readings.held_out], data.readings[data.readings.held_out]
    return _coordinate(how.residual(data.model, away, how.start(data.model, fitted)))


def _coordinate(gap: Array) -> float:
    return float(np.sqrt(np.mean(gap**2)))


@click.command()
@click.option("--figaroh", default=None, help="Python with FIGAROH; left out: not compared.")
@click.option("--measured", "folder", type=click.Path(path_type=Path), default=None,
              help="Folder of the measured sets; left out: simulated ones alone.")  # fmt: skip
@click.option("--seed", default=0, show_default=True)
@click.option("--patience", default=PATIENCE, show_default=True,
              help="Seconds that FIGAROH has for one set.")  # fmt: skip
@click.option("--json", "out", type=click.Path(path_type=Path), default=None, help="Write figures.")
def main(
    figaroh: str | None, folder: Path | None, seed: int, patience: float, out: Path | None
) -> None:
    """Compare programs on the same rows."""
    sets = [simulated(arm, seed) for arm in ARMS]
    sets += [simulated(arm, seed, loads=False) for arm in ALONE]
    if folder is not None:
        sets += [measured(name, folder) for name in MEASURED if (folder / name).is_dir()]
    programs: dict[str, Callable[[DataSet], tuple[float, float, int, str]]] = {
        "Gapbridge": by_gapbridge, "scipy, DH": by_scipy,
    }  # fmt: skip
    if figaroh is not None:
        programs["FIGAROH"] = lambda data: by_figaroh(data, figaroh, patience)
    done = []
    by_gapbridge(sets[0])  # what is compiled at first use is no part of a fit
    for data in sets:
        before = nominal(data)
        for name, program in programs.items():
            held, seconds, count, note = program(data)
            done.append(Row(data.name, name, before, held, data.floor, seconds, count, note))
            if out is not None:
                out.write_text(json.dumps([asdict(r) for r in done], indent=1), encoding="utf-8")
    _show(done)


def _show(done: list[Row]) -> None:
    table = Table("data", "program", "before, mm", "held out, mm", "floor, mm", "s", "parameters")
    for r in done:
        table.add_row(
            r.data, r.program, *(f"{1e3 * v:.4f}" for v in (r.before, r.held_out, r.floor)),
            f"{r.seconds:.1f}", str(r.parameters),
        )  # fmt: skip
    console = Console()
    console.print(table)
    for r in done:
        if r.note.startswith("failed"):
            console.print(f"{r.data}, {r.program}: {r.note}")


if __name__ == "__main__":
    main()
