"""Calibration sessions run in this process with scripted input lines."""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.calibration.session.session import plan_of
from gapbridge.bridge.cli import main
from gapbridge.core.arm import builtin_arm
from gapbridge.core.calibration.plan import Plan
from gapbridge.core.effects import Site, Term
from gapbridge.core.estimation.registration import Registration
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.rotation import rotation_matrix

Array = NDArray[np.float64]
CELL = """\
robot: {{model: ur10e}}
metrology: {{registered: {registered}, sigma: 2.0e-5}}
calibration:
  instrument: {instrument}
  joints: {joints}
  loads: [{{name: light, mass: 1.0}}, {{name: heavy, mass: 9.0, cog: [0.0, 0.0, 0.1]}}]
  effects: [joint_offset, axial_compliance]
  poses: {poses}
  held_out: {held_out}
  repeats: 2
  folder: sessions
"""
AXIAL = (3e-6, 8e-6, 7e-6, 1e-5, 1.2e-5, 2e-5)  # rad/Nm
FRAME = Registration(rotation_matrix(np.array([0.1, -0.2, 0.7])), np.array([2.5, -0.8, 0.3]))
KNOCKED = Registration(
    rotation_matrix(np.array([0.1, -0.2, 0.702])),
    FRAME.position + np.array([0.002, 0.001, -0.0015]),
)


@dataclass(frozen=True)
class CommandResult:
    """Exit code and output of a call of the command."""

    code: int
    out: str
    err: str


def write_cell(folder: Path, **changed: object) -> Path:
    given = {
        "registered": "false", "instrument": "{kind: typed, unit: m}", "joints": "planned",
        "poses": 14, "held_out": 8, **changed,
    }  # fmt: skip
    path = folder / "cell.yaml"
    path.write_text(CELL.format(**given), encoding="utf-8")
    return path


def run_calibrate(cell: Path, *arguments: object, lines: Sequence[str] = ()) -> CommandResult:
    """Run the command in this process with ``lines`` as input, then its end."""
    out, err = io.StringIO(), io.StringIO()
    read, write = os.pipe()
    with os.fdopen(write, "w") as reading_line:
        reading_line.write("".join(f"{line}\n" for line in lines))
    before, sys.stdin = sys.stdin, os.fdopen(read)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main(["calibrate", str(cell), *map(str, arguments)])
    except SystemExit as leaving:
        code = leaving.code
    finally:
        sys.stdin.close()
        sys.stdin = before
    assert isinstance(code, int)
    return CommandResult(code, out.getvalue(), err.getvalue())


def plan_in(session: Path) -> Plan:
    entries = read_entries(session / FILE)
    return plan_of(next(e["plan"] for e in entries if e["kind"] == "plan"))


def truth() -> Model:
    """Return the true arm."""
    terms = [Term("joint_offset", Site(j), (v,)) for j, v in ((2, 8e-4), (3, -6e-4), (5, 5e-4))]
    return Model(builtin_arm("ur10e")).with_terms(terms).with_compliance(AXIAL, (0.0,) * 6)


def tracker_readings(plan: Plan, seed: int = 0, frame: Registration | None = FRAME) -> Array:
    """Return the readings of a tracker at each stop (N, 3), m."""
    q = np.array([p.q for p in plan.poses])
    loads = Loads(
        payload_mass=np.array([plan.loads[p.load].mass for p in plan.poses]),
        payload_cog=np.array([plan.loads[p.load].cog for p in plan.poses]),
    )
    found = truth().predict(q, loads).position
    found = found + np.random.default_rng(seed).normal(0, 3e-5, found.shape)
    return found if frame is None else found @ frame.rotation.T + frame.position


def reading_line(value: Array, factor: float = 1.0) -> str:
    return " ".join(f"{v * factor:.9f}" for v in value)


def session_lines(plan: Plan, readings: Sequence[str]) -> list[str]:
    """Return the input of a session without mistakes: Enter for each load, a reading per stop."""
    lines, mounted = [], None
    for pose, reading in zip(plan.poses, readings, strict=True):
        if pose.load != mounted:
            lines.append("")
            mounted = pose.load
        lines.append(reading)
    return lines
