"""The loop that users close: gap, cause by name, patched model, no gap.

The real arm is a MuJoCo model with an effect put in here, by code of its own; the logs are those of
a position controller in MuJoCo.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.patch.arms import BASE_AT, BASE_TURN, UR_JOINTS, mjcf
from gapbridge.core.arm import builtin_arm

mujoco = pytest.importorskip("mujoco")

pytestmark = pytest.mark.slow
ARM = builtin_arm("ur10e")
POSES, LOADS = 28, (0.5, 6.0)  # kg
KP = 4e4
NOISE = 2e-5  # m
AT_REST = 2e-5  # rad/s
CELL = """
robot: {model: ur10e}
tool: {tcp: {xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}
metrology: {registered: false, sigma: 2.0e-5}
"""
Put = Callable[[Any], None]


def joint_zero(spec: Any) -> None:
    """Turn the elbow's body by 3 mrad about the joint's axis."""
    body, joint = spec.body("link_3"), spec.joint("elbow_joint")
    own = Rotation.from_quat(np.roll(body.quat, -1))
    turned = own * Rotation.from_rotvec(3e-3 * np.array(joint.axis))
    body.quat = np.roll(turned.as_quat(), 1)


def longer_link(spec: Any) -> None:
    """Make the forearm 1.5 mm longer."""
    along = np.array(spec.body("link_4").pos)
    spec.body("link_4").pos = along * (1 + 1.5e-3 / 0.57155)


def soft_joint(spec: Any) -> None:
    """Put a spring of 40 kNm/rad behind the shoulder's joint."""
    joint = spec.joint("shoulder_lift_joint")
    spec.body("link_2").add_joint(
        name="soft", type=mujoco.mjtJoint.mjJNT_HINGE, axis=np.array(joint.axis),
        stiffness=[4e4, 0, 0], damping=[2500.0, 0, 0], armature=1e-3,
    )  # fmt: skip


def measured(spec: Any, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return encoder angles and the TCP in base (N, 3) at rest, for commands q (N, 6)."""
    compiled = spec.compile()
    data = mujoco.MjData(compiled)
    at = [compiled.joint(name).qposadr[0] for name in UR_JOINTS]
    angles, positions = [], []
    for command in q:
        mujoco.mj_resetData(compiled, data)
        data.qpos[at], data.ctrl[:] = command, command
        for _ in range(50):
            mujoco.mj_step(compiled, data, nstep=100)
            if np.abs(data.qvel).max() < AT_REST:
                break
        else:
            raise AssertionError(f"still moving at {np.abs(data.qvel).max():g} rad/s")
        angles.append(data.qpos[at].copy())
        positions.append(BASE_TURN.inv().apply(data.site("tcp").xpos - BASE_AT))
    return np.array(angles), np.array(positions)


def write_log(path: Path, q: np.ndarray, put: Put | None, text: Callable[[float], str],
              noise: float) -> None:  # fmt: skip
    """Write what was measured under each load in turn."""
    rng = np.random.default_rng(11)
    rows = []
    for k, load in enumerate(LOADS):
        spec = mujoco.MjSpec.from_string(text(load))
        if put is not None:
            put(spec)
        own = q[k :: len(LOADS)]
        angles, positions = measured(spec, own)
        positions = positions + rng.normal(0, noise, positions.shape) if noise else positions
        cog = np.tile([0, 0, 0.1], (len(own), 1))
        rows.append(np.hstack([own, angles, np.full((len(own), 1), load), cog, positions]))
    names = [*(f"target_q_{i}" for i in range(6)), *(f"actual_q_{i}" for i in range(6)), "payload",
             *(f"payload_cog_{i}" for i in range(3)),
             *(f"measured_position_{i}" for i in range(3))]  # fmt: skip
    lines = [",".join(names)] + [",".join(f"{v:.17g}" for v in row) for row in np.vstack(rows)]
    path.write_text("\n".join(lines) + "\n")


def gapbridge(folder: Path, *phrase: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "gapbridge", *phrase], capture_output=True, text=True, timeout=200,
        check=False, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def position(folder: Path, file: str) -> dict[str, Any]:
    channels = json.loads((folder / file).read_text())["channels"]
    return next(c for c in channels if c["channel"] == "position")


@pytest.mark.parametrize(
    ("put", "effect", "joint"),
    [
        (joint_zero, "joint_offset", 3),
        (longer_link, "link_geometry", 3),
        (soft_joint, "axial_compliance", 2),
    ],
    ids=["joint_zero", "longer_link", "soft_joint"],
)
def test_a_gap_is_named_patched_and_gone(tmp_path: Path, put: Put, effect: str, joint: int) -> None:
    q = np.random.default_rng(3).uniform(-1.5, 1.5, (POSES, 6))

    def nominal(load: float) -> str:
        return mjcf(ARM, UR_JOINTS, kp=KP, load=load)

    def from_file(load: float) -> str:
        """Return the patched model with a load hung in."""
        text = (tmp_path / "patched.xml").read_text()
        spec = mujoco.MjSpec.from_string(text)
        spec.body("load").mass = load
        return str(spec.to_xml())

    (tmp_path / "cell.yaml").write_text(CELL)
    (tmp_path / "model.xml").write_text(nominal(1.0))
    write_log(tmp_path / "real.csv", q, put, nominal, NOISE)
    write_log(tmp_path / "sim.csv", q, None, nominal, 0.0)
    before = ["diagnose", "real.csv", "--cell", "cell.yaml", "--sim", "sim.csv"]
    gapbridge(tmp_path, *before, "--json", "before.json", "--apply", "better.yaml")
    causes = position(tmp_path, "before.json")["causes"]
    assert [(c["effect"], c["joints"]) for c in causes] == [(effect, [joint])]
    gapbridge(tmp_path, "patch", "model.xml", "--cell", "better.yaml", "--out", "patched.xml",
              "--tcp", "tcp")  # fmt: skip
    write_log(tmp_path / "again.csv", q, None, from_file, 0.0)
    gapbridge(tmp_path, "diagnose", "real.csv", "--cell", "cell.yaml", "--sim", "again.csv",
              "--json", "after.json")  # fmt: skip
    after = position(tmp_path, "after.json")
    assert after["verdict"] == "no_gap"
    assert after["gap_rms"] < 0.2 * position(tmp_path, "before.json")["gap_rms"]
