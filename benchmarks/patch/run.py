"""One case of the loop: simulate, diagnose, patch, simulate again, diagnose again."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.patch.arms import WrittenArm, mjcf
from benchmarks.patch.cases import APPROACHED, DROOP, KP, KV, MOVING, TORQUE, WRENCH, Case
from benchmarks.patch.simulated import (
    LOAD_COG,
    Plant,
    at_rest,
    in_motion,
    motion,
    write_log,
)

Array = NDArray[np.float64]
POSES, LOADS, WRITTEN_LOAD = 36, (0.5, 4.0, 8.0), 1.0  # kg
NOISE = {"measured_position": 2e-5, "actual_q": 1e-5, "actual_current_as_torque": 0.1,
         "ft_raw_wrench": 0.05}  # fmt: skip
LOGGED = {MOVING: 5, TORQUE: 20}  # steps between two rows of a motion
BEGIN = 2.5  # s of a motion that are left out: until it has swelled
CELL = """\
robot:
  {robot}
tool: {{tcp: {{xyz: [0, 0, 0.1], rpy: [0, 0, 0]}}}}
payload: {{mass: {load}, cog: [0, 0, 0.1]}}
metrology: {{registered: false, sigma: 2.0e-5}}
"""
TIMEOUT = 900.0  # s of one command


def run(arm: WrittenArm, case: Case, folder: Path) -> dict[str, Any]:
    """Return what came of one case, as the table has it; files stay in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cell.yaml").write_text(CELL.format(robot=arm.robot, load=WRITTEN_LOAD))
    (folder / "model.xml").write_text(_text(arm)(WRITTEN_LOAD))
    nominal = Plant(_text(arm))
    _log(arm, case, _real(arm, case), folder / "real.csv", noisy=True)
    _log(arm, case, nominal, folder / "sim.csv")
    before = _diagnosed(folder, "sim.csv", "before.json", case, ["--apply", "better.yaml"])
    printed = _gapbridge(
        folder, "patch", "model.xml", "--cell", "better.yaml", "--out", "patched.xml", "--tcp",
        "tcp", "--load", "load",
    )  # fmt: skip
    _log(arm, case, Plant(_patched(folder)), folder / "again.csv")
    after = _diagnosed(folder, "again.csv", "after.json", case, [])
    accused = {p["name"]: p["value"] for c in before["causes"] for p in c["parameters"]}
    causes = [(c["effect"], c["joints"]) for c in before["causes"]]
    named = any(
        effect == case.effect and (case.joint is None or case.joint in joints)
        for effect, joints in causes
    )
    return {
        "arm": arm.name, "effect": case.effect, "parameter": case.name, "value": case.value,
        "found": accused.get(case.name), "named": named,
        "others": sorted({effect for effect, _ in causes if effect != case.effect}),
        "ties": sorted({t for c in before["causes"] for t in c["indistinguishable_from"]}),
        "channel": case.channel, "unit": before["unit"], "gap": before["gap_rms"],
        "patched": after["gap_rms"], "floor": after["noise_floor_rms"],
        "verdict": after["verdict"], "not_held": printed.count("not held:"),
    }  # fmt: skip


def _text(arm: WrittenArm, **given: Any) -> Callable[[float], str]:
    return lambda load: mjcf(arm.arm, arm.joints, kp=KP, kv=KV, load=load, **given)


def _patched(folder: Path) -> Callable[[float], str]:
    """Return the patched model with another load: as much more as its own was patched."""
    text = (folder / "patched.xml").read_text()

    def at(load: float) -> str:
        spec = mujoco.MjSpec.from_string(text)
        body = spec.body("load")
        body.mass += load - WRITTEN_LOAD
        spec.compile()
        return str(spec.to_xml())

    return at


def _real(arm: WrittenArm, case: Case) -> Plant:
    """Return the arm with the effect in it."""

    def put(spec: Any) -> None:
        load = spec.body("load")
        load.mass += case.heavier
        load.pos = np.add(load.pos, [case.shifted, 0, 0])
        if case.put is not None:
            case.put(spec, arm)

    plant = Plant(_text(arm, soft=case.soft), put, case.servo)
    if case.stiffening is None:
        return plant
    c, moment = case.stiffening
    joint = case.joint

    def softer(spec: Any) -> None:
        put(spec)
        own = spec.joint(arm.joints[joint - 1])
        spec.body(f"link_{joint}").add_joint(
            name="stiffening", type=mujoco.mjtJoint.mjJNT_HINGE, axis=np.array(own.axis),
            damping=[2000.0, 0, 0], armature=1e-3,
        )  # fmt: skip

    def torque(model: Any, data: Any) -> None:
        own = model.joint("stiffening")
        angle = data.qpos[own.qposadr[0]]
        share = min((angle / (c * moment)) ** 2, 0.95)
        data.qfrc_applied[own.dofadr[0]] = -angle / c / np.sqrt(1 - share)

    return replace(plant, put=softer, torque=torque)


def _log(arm: WrittenArm, case: Case, plant: Plant, path: Path, noisy: bool = False) -> None:
    """Write what one plant shows in a case's experiment."""
    rng = np.random.default_rng(11)
    moving = case.kind in (MOVING, TORQUE)
    columns = _motion(arm, case, plant) if moving else _poses(arm, case, plant)
    if noisy:
        for name in columns:
            if name in NOISE and not (name == "actual_q" and case.kind == TORQUE):
                columns[name] = columns[name] + rng.normal(0, NOISE[name], columns[name].shape)
    write_log(path, columns)


def _motion(arm: WrittenArm, case: Case, plant: Plant) -> dict[str, Array]:
    t, q = motion(arm, seed=4)
    logged = LOGGED[case.kind]
    found = in_motion(arm, plant, WRITTEN_LOAD, q, logged)
    keep = t[::logged] >= BEGIN
    columns = {"timestamp": t[::logged][keep]}
    if case.kind == MOVING:
        return {**columns, "target_q": q[::logged][keep], "actual_q": found["actual_q"][keep]}
    load = {"payload": np.full(keep.sum(), WRITTEN_LOAD),
            "payload_cog": np.tile(LOAD_COG, (keep.sum(), 1))}  # fmt: skip
    return {**columns, **{name: values[keep] for name, values in found.items()}, **load}


def _poses(arm: WrittenArm, case: Case, plant: Plant) -> dict[str, Array]:
    rng = np.random.default_rng(3)
    q = rng.uniform(-1.4, 1.4, (POSES, arm.n))
    approach = rng.choice([-1.0, 1.0], q.shape) if case.kind == APPROACHED else None
    parts: list[dict[str, Array]] = []
    for k, load in enumerate(LOADS):
        own = slice(k, None, len(LOADS))
        found = at_rest(arm, plant, load, q[own], None if approach is None else approach[own])
        count = len(q[own])
        found |= {"target_q": q[own], "payload": np.full(count, load),
                  "payload_cog": np.tile(LOAD_COG, (count, 1))}  # fmt: skip
        if approach is not None:
            found["approach"] = approach[own]
        parts.append(found)
    seen = {WRENCH: "ft_raw_wrench", DROOP: ""}.get(case.kind, "measured_position")
    names = ["target_q", "actual_q", "payload", "payload_cog", *([seen] if seen else [])]
    names += ["approach"] if approach is not None else []
    if case.kind != DROOP:
        names.remove("target_q")
    return {name: np.concatenate([part[name] for part in parts]) for name in names}


def _diagnosed(folder: Path, sim: str, file: str, case: Case, more: list[str]) -> dict[str, Any]:
    _gapbridge(folder, "diagnose", "real.csv", "--cell", "cell.yaml", "--sim", sim, "--json", file,
               *more)  # fmt: skip
    channels = json.loads((folder / file).read_text())["channels"]
    found: dict[str, Any] = next(c for c in channels if c["channel"] == case.channel)
    return found


def _gapbridge(folder: Path, *phrase: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "gapbridge", *phrase], capture_output=True, text=True,
        timeout=TIMEOUT, check=False, cwd=folder,
    )  # fmt: skip
    if done.returncode:
        raise RuntimeError(f"{phrase[0]}: exit {done.returncode}: {done.stderr.strip()[-500:]}")
    return done.stdout
