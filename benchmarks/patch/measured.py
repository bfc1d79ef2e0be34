"""Measured arms: found geometry into a URDF, whose kinematics Pinocchio computes.

The log is diagnosed, what was found is patched into a URDF of the nominal arm, and Pinocchio's
TCP at every measured pose is held against the product's own prediction. What a URDF cannot hold
(flexibility, a periodic error) is left out of both.
"""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.patch.arms import urdf
from gapbridge.bridge.cell import load_cell
from gapbridge.bridge.patch import changes_of
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.log.log import read_log

DATA = Path("../shared/data")
SETS = ("tsinghua_ur5_grid", "tsinghua_ur5_random", "ipa_ur10_b")
ROWS = 120  # of a set, evenly taken: what a diagnosis finds geometry in within a minute
SIMILAR = 1e-9  # m


@dataclass(frozen=True)
class Compared:
    """One set: what the diagnosis put in, and how far the two kinematics are apart."""

    name: str
    poses: int
    effects: tuple[str, ...]
    changed: int  # attributes' lines of the patch
    moved: float  # m, rms, by which the patch moves the TCP
    apart: float  # m, largest


def compared(name: str, folder: Path) -> Compared:
    """Return what a measured set shows; files stay in the folder."""
    import pinocchio

    folder.mkdir(parents=True, exist_ok=True)
    given = (DATA / name / "log.csv").read_text().splitlines()
    take = np.unique(np.linspace(1, len(given) - 1, ROWS).astype(int))
    (folder / "log.csv").write_text("\n".join([given[0], *(given[i] for i in take)]) + "\n")
    (folder / "cell.yaml").write_text((DATA / name / "cell.yaml").read_text())
    _gapbridge(folder, "diagnose", "log.csv", "--cell", "cell.yaml", "--apply", "found.yaml")
    nominal, cell = load_cell(folder / "cell.yaml"), load_cell(folder / "found.yaml")
    arm = nominal.arm
    names = tuple(f"joint_{i + 1}" for i in range(arm.n))
    tool = nominal.model.tool_in_flange[:3, 3]
    (folder / "nominal.urdf").write_text(urdf(arm, names, tcp=tool))
    printed = _gapbridge(folder, "patch", "nominal.urdf", "--cell", "found.yaml", "--out",
                         "patched.urdf", "--tcp", "tool")  # fmt: skip
    elsewhere = {effect for effect, _ in changes_of(cell.model).unsupported}
    terms = [t for t in cell.model.terms
             if not CATALOGUE[t.effect].softens and t.effect not in elsewhere]  # fmt: skip
    rigid = cell.model.without_terms().with_terms(terms)
    q = read_log(folder / "log.csv", arm.n).require("actual_q")
    robot = pinocchio.buildModelFromUrdf(str(folder / "patched.urdf"))
    data, frame = robot.createData(), robot.getFrameId("tool")
    found = np.empty((len(q), 3))
    for k, angles in enumerate(q):
        pinocchio.framesForwardKinematics(robot, data, angles)
        found[k] = data.oMf[frame].translation
    expected, before = rigid.predict(q).position, nominal.model.predict(q).position
    return Compared(
        name, len(q), tuple(dict.fromkeys(t.effect for t in terms)),
        printed.count("origin") + printed.count("TCP"),
        float(np.sqrt(np.mean(np.sum((expected - before) ** 2, axis=1)))),
        float(np.linalg.norm(found - expected, axis=1).max()),
    )  # fmt: skip


def line(result: Compared) -> str:
    """Return one set for the terminal."""
    effects = ", ".join(result.effects) or "nothing"
    return (f"{result.name:22} {result.poses} poses: {effects}; moves the TCP by "
            f"{1e3 * result.moved:.3g} mm rms; Pinocchio {result.apart:.2g} m apart")  # fmt: skip


def _gapbridge(folder: Path, *phrase: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "gapbridge", *phrase], capture_output=True, text=True, timeout=900,
        check=False, cwd=folder,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{phrase[0]}: exit {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout
