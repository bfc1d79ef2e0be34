"""MuJoCo under position control, and the logs of it: poses at rest, or one motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.patch.arms import BASE_AT, BASE_TURN, WrittenArm

Array = NDArray[np.float64]
AT_REST = 2e-5  # rad/s
STEP = 1e-3  # s
DURATION = 14.0  # s of a motion
AWAY = 0.08  # rad from which a pose is approached
APPROACH = 2.0  # s that the approach takes
LOAD_COG = (0.0, 0.0, 0.1)  # m, flange axes


@dataclass(frozen=True)
class Servo:
    """What the control loop does to one joint's command (number from 0)."""

    joint: int = 0
    delay: float = 0.0  # s
    lag: float = 0.0  # s, time constant: sampled, it answers half a step earlier


@dataclass(frozen=True)
class Plant:
    """A simulated arm: the text of its model for a load, what is put in, and its control loop."""

    text: Callable[[float], str]
    put: Callable[[Any], None] | None = None
    servo: Servo = field(default_factory=Servo)
    torque: Callable[[Any, Any], None] | None = None  # (model, data), before each step

    def compiled(self, load: float) -> tuple[Any, Any]:
        """Return model and data under a load, kg."""
        spec = mujoco.MjSpec.from_string(self.text(load))
        if self.put is not None:
            self.put(spec)
        model = spec.compile()
        return model, mujoco.MjData(model)


def steps(plant: Plant, model: Any, data: Any, count: int) -> None:
    """Step, with the plant's own torques where it has them."""
    if plant.torque is None:
        mujoco.mj_step(model, data, nstep=count)
        return
    for _ in range(count):
        plant.torque(model, data)
        mujoco.mj_step(model, data)


def at_rest(
    arm: WrittenArm, plant: Plant, load: float, q: Array, approach: Array | None
) -> dict[str, Array]:
    """Return the log's columns at rest for commands q (N, n); approach (N, n): signs, or None."""
    model, data = plant.compiled(load)
    at = [model.joint(name).qposadr[0] for name in arm.joints]
    rows: dict[str, list[Array]] = {"actual_q": [], "measured_position": [], "ft_raw_wrench": []}
    for k, command in enumerate(q):
        mujoco.mj_resetData(model, data)
        begin = command if approach is None else command - AWAY * approach[k]
        data.qpos[at], data.ctrl[:] = begin, begin
        if approach is not None:
            steps(plant, model, data, 500)
            count = int(APPROACH / STEP)
            for s in np.linspace(0, 1, count):
                data.ctrl[:] = begin + (command - begin) * s**3 * (10 - 15 * s + 6 * s * s)
                steps(plant, model, data, 1)
        for _ in range(200):
            steps(plant, model, data, 100)
            if np.abs(data.qvel).max() < AT_REST:
                break
        else:
            raise AssertionError(f"still moving at {np.abs(data.qvel).max():g} rad/s")
        rows["actual_q"].append(data.qpos[at].copy())
        rows["measured_position"].append(BASE_TURN.inv().apply(data.site("tcp").xpos - BASE_AT))
        reads = [data.sensor(name).data for name in ("ft_force", "ft_torque")]
        rows["ft_raw_wrench"].append(-np.concatenate(reads))  # MuJoCo: what holds the load
    return {name: np.array(values) for name, values in rows.items()}


def motion(arm: WrittenArm, seed: int) -> tuple[Array, Array]:
    """Return times (N,) and commands (N, n) of every step: sums of sines, from rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(DURATION / STEP)) * STEP
    q = np.zeros((len(t), arm.n))
    swell = np.clip(t / 2.0, 0, 1) ** 2 * (3 - 2 * np.clip(t / 2.0, 0, 1))
    for j in range(arm.n):
        middle = rng.uniform(-0.6, 0.6)
        for frequency, amplitude in ((rng.uniform(0.1, 0.2), 0.5), (rng.uniform(0.3, 0.5), 0.15)):
            phase = rng.uniform(0, 2 * np.pi)
            q[:, j] += swell * amplitude * np.sin(2 * np.pi * frequency * t + phase)
        q[:, j] += middle
    return t, q


def in_motion(
    arm: WrittenArm, plant: Plant, load: float, q: Array, logged: int
) -> dict[str, Array]:
    """Return the log's columns while the commands q (steps, n) are played, every so many steps."""
    model, data = plant.compiled(load)
    at = [model.joint(name).qposadr[0] for name in arm.joints]
    dof = [model.joint(name).dofadr[0] for name in arm.joints]
    command = _through(q, plant.servo)
    data.qpos[at] = q[0]
    data.ctrl[:] = q[0]
    if model.na:
        data.act[:] = q[0][np.flatnonzero(model.actuator_actnum)]
    steps(plant, model, data, 3000)
    rows: dict[str, list[Array]] = {"actual_q": [], "actual_qd": [], "actual_current_as_torque": []}
    for k in range(len(q)):
        if k % logged == 0:
            mujoco.mj_forward(model, data)
            rows["actual_q"].append(data.qpos[at].copy())
            rows["actual_qd"].append(data.qvel[dof].copy())
            rows["actual_current_as_torque"].append(data.qfrc_actuator[dof].copy())
        data.ctrl[:] = command[k]
        steps(plant, model, data, 1)
    return {name: np.array(values) for name, values in rows.items()}


def _through(q: Array, servo: Servo) -> Array:
    """Return the commands as they arrive at the drives."""
    j, found = servo.joint, q.copy()
    if servo.delay:
        late = round(servo.delay / STEP)
        found[late:, j], found[:late, j] = q[:-late, j], q[0, j]
    if servo.lag:
        share = 1 - np.exp(-STEP / servo.lag)
        for k in range(1, len(q)):
            found[k, j] = found[k - 1, j] + share * (q[k, j] - found[k - 1, j])
    return found


def write_log(path: Path, columns: dict[str, Array]) -> None:
    """Write columns (N,) or (N, k) as a log."""
    names, parts = [], []
    for name, values in columns.items():
        wide = values.reshape(len(values), -1)
        names += [name] if values.ndim == 1 else [f"{name}_{i}" for i in range(wide.shape[1])]
        parts.append(wide)
    lines = [",".join(names)]
    lines += [",".join(f"{v:.12g}" for v in row) for row in np.hstack(parts)]
    path.write_text("\n".join(lines) + "\n")
