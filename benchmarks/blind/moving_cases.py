"""Cases of the tracking and torque channels: 30 s of motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.random import Generator

from benchmarks.blind.arms import ARMS, ArmKind
from benchmarks.blind.bench import Bench, draw_bench
from benchmarks.blind.mechanics import Array, Session, loads_of, stand
from benchmarks.blind.moving import Motion, draw_motion, shifts_of, torque_shares
from benchmarks.blind.parametric import Candidate, Parametric, Place, Values
from benchmarks.blind.session import Plan

TRACKING = ("latency", "tracking_lag", "servo_droop", "dead_band")
TRACKING_OUTSIDE = ("droop", "track_step", "speed_loss")
TRACKING_REMAINDERS = ("coupled",)
TORQUE_REMAINDERS = ("torque_field",)
TORQUE = (
    "coulomb_friction", "viscous_friction", "rotor_inertia", "link_inertia", "torque_constant",
    "payload", "payload_cog", "torque_offset", "stribeck_friction", "load_friction", "link_cog",
)  # fmt: skip
TORQUE_OUTSIDE = ("cogging", "warm_friction")
Move = Callable[[ArmKind, Generator], Motion]
draw_tracking_motion: Move = partial(draw_motion, swift=1.5)


@dataclass(frozen=True)
class MovingCell:
    """A cell with a motion in it and what its encoders are worth."""

    bench: Bench  # its session is not used, but for a declared payload
    motion: Motion
    time: Array  # (N,)
    truth: Parametric
    encoder: float  # rad, step of the encoder
    shake: float  # rad, noise before the step
    payload: Array  # (N,) kg, declared

    @property
    def kind(self) -> ArmKind:
        """Return the arm."""
        return self.bench.kind

    def encoded(self, q: Array, rng: Generator) -> Array:
        """Return angles as the encoder gives them."""
        noisy = q + rng.normal(0, self.shake, q.shape)
        return np.asarray(np.round(noisy / self.encoder) * self.encoder)


def _clock(rng: Generator, seconds: float) -> Array:
    rate = float(rng.choice([125.0, 250.0, 500.0], p=[0.2, 0.3, 0.5]))
    return np.asarray(np.arange(int(seconds * rate)) / rate)


def draw_tracking_cell(
    rng: Generator, seconds: float = 30.0, move: Move = draw_tracking_motion
) -> MovingCell:
    """Return a cell whose joints follow their commands late."""
    bench = draw_bench(rng, Plan(poses=12, blocks=1), with_rotation=False, compliant=False)
    kind = bench.kind
    motion, time = move(kind, rng), _clock(rng, seconds)
    encoder = 2 * np.pi / 2 ** int(rng.integers(17, 21))
    shake = float(rng.uniform(5e-6, 3e-5))
    candidates: dict[Place, Candidate] = {
        (effect, j): Candidate((f"{effect}_{j}",), np.array([usual]), 8)
        for effect, usual in (("latency", 8e-3), ("tracking_lag", 1e-2), ("dead_band", 2e-3))
        for j in range(1, kind.n + 1)
    }
    held = _held(bench, motion.at(time))
    largest = max(float(np.abs(held).max()), 1e-9)
    for j in range(1, kind.n + 1):
        usual = 5e-3 / max(float(np.abs(held[:, j - 1]).max()), 0.03 * largest)
        candidates[("servo_droop", j)] = Candidate((f"servo_droop_{j}",), np.array([usual]), 8)

    def read(values: Values) -> Array:
        delay, lag, droop, band = (
            np.array([values.get((effect, j), np.zeros(1))[0] for j in range(1, kind.n + 1)])
            for effect in TRACKING
        )
        wanted = stood = motion.lagged(time, delay, lag)
        for _ in range(8 if droop.any() else 0):  # the weight droops where the arm stands
            stood = wanted - droop * _held(bench, stood)
        return resting(stood, np.abs(band))

    sigma = np.full(kind.n, np.hypot(shake, encoder / np.sqrt(12)))
    truth = Parametric(read, sigma, candidates)
    payload = np.full(len(time), bench.session.payload_mass[0])
    return MovingCell(bench, motion, time, truth, encoder, shake, payload)


def _held(bench: Bench, q: Array) -> Array:
    """Return the torques (N, n) that the motors hold at rest: weights of links and payload."""
    one, count = bench.session, len(q)
    session = Session(
        np.zeros(count), q, np.full(count, one.payload_mass[0]),
        np.tile(one.payload_cog[0], (count, 1)), np.zeros((count, 6)), np.full(q.shape, 25.0),
        np.zeros_like(q), q,
    )  # fmt: skip
    shape = stand(bench.nominal, session)
    loads = loads_of(bench.nominal, session, shape)
    about = [
        np.sum(loads.about(shape.origin[i], i) * shape.axes[i][:, :, 2], axis=1)
        for i in range(q.shape[1])
    ]
    return -np.column_stack(about)


def resting(target: Array, band: Array) -> Array:
    """Return where servos stand (N, n) that move only once the target is further off than a band.

    They begin on target.
    """
    if not band.any():
        return target
    stand, at = np.empty_like(target), target[0]
    for k, wanted in enumerate(target):
        off = wanted - at
        at = np.where(np.abs(off) > band, wanted - np.sign(off) * band, at)
        stand[k] = at
    return stand


def draw_torque_cell(
    rng: Generator, seconds: float = 30.0, move: Move = draw_motion,
    knee: tuple[float, float] = (0.04, 0.15), loads: int = 1,
) -> MovingCell:  # fmt: skip
    """Return a cell whose joint torques are measured along an exciting motion, under each load."""
    arm, plan = str(rng.choice(list(ARMS))), Plan(poses=12, blocks=loads)
    bench = draw_bench(rng, plan, arm=arm, with_rotation=False, compliant=False)
    kind, session = bench.kind, bench.session
    motion, time = move(kind, rng), _clock(rng, seconds)
    q, qd, qdd = (motion.at(time, k) for k in range(3))
    mass = session.payload_mass[np.arange(len(time)) * len(session.q) // len(time)]
    cog = session.payload_cog[0]
    links, carried = torque_shares(kind.rows, bench.nominal.gravity, cog, q, qd, qdd)
    shifts = shifts_of(kind.rows, bench.nominal.gravity, cog, q, qd, qdd)
    rigid = links.sum(axis=0) + mass[:, None] * carried
    usual = np.sqrt(np.mean(rigid**2, axis=0)) + 0.02 * np.sqrt(np.mean(rigid**2))
    sigma = usual * rng.uniform(0.01, 0.03)
    peak = np.abs(qd).max(axis=0)
    speed, swing = np.sqrt(np.mean(qd**2, axis=0)), np.sqrt(np.mean(qdd**2, axis=0))
    candidates: dict[Place, Candidate] = {
        ("payload", None): Candidate(("payload",), np.array([0.05 * kind.rated]), 8),
        ("payload_cog", None): Candidate(
            tuple(f"payload_cog_{k}" for k in "xyz"), np.full(3, 0.1 * kind.tool), 10
        ),
    }
    for j in range(1, kind.n + 1):
        u = usual[j - 1]
        for effect, scale in (
            ("coulomb_friction", 0.1 * u),
            ("viscous_friction", 0.1 * u / speed[j - 1]),
            ("rotor_inertia", 0.1 * u / swing[j - 1]),
            ("link_inertia", 0.05),
            ("torque_constant", 0.05),
            ("torque_offset", 0.1 * u),
            ("load_friction", 0.1),
        ):
            candidates[(effect, j)] = Candidate((f"{effect}_{j}",), np.array([scale]), 8)
        candidates[("stribeck_friction", j)] = Candidate(
            (f"stribeck_friction_{j}",), np.array([0.1 * u]), 8
        )
        candidates[("link_cog", j)] = Candidate(
            tuple(f"link_cog_{j}_{k}" for k in "xyz"), np.full(3, 0.02 * kind.rows[j - 1].mass), 5
        )
    slow = peak * rng.uniform(*knee, kind.n)  # rad/s, where Stribeck's curve falls

    def read(values: Values) -> Array:
        def of(effect: str, j: int) -> float:
            return float(values[(effect, j)][0]) if (effect, j) in values else 0.0

        joints = range(1, kind.n + 1)
        more = float(values.get(("payload", None), np.zeros(1))[0])
        out = rigid + more * carried
        shift = values.get(("payload_cog", None), np.zeros(3))
        if shift.any():
            out = out + shifts.of_payload(mass + more, shift)
        for j in joints:
            out = out + of("link_inertia", j) * links[j - 1]
            if ("link_cog", j) in values:
                moment = values[("link_cog", j)]
                if kind.as_urdf:  # reported in the axes of the link as the file has it
                    moment = shifts.places[j - 1].rotation.T @ moment
                out = out + shifts.of_link(j - 1, moment)
        share = np.array([of("load_friction", j) for j in joints])
        break_away = np.array([of("stribeck_friction", j) for j in joints])
        offset = np.array([of("torque_offset", j) for j in joints])
        out = out + (share * np.abs(out) + break_away * np.exp(-((qd / slow) ** 2))) * np.sign(qd)
        coulomb = np.array([of("coulomb_friction", j) for j in joints])
        viscous = np.array([of("viscous_friction", j) for j in joints])
        rotor = np.array([of("rotor_inertia", j) for j in joints])
        scale = 1 + np.array([of("torque_constant", j) for j in joints])
        out = (out + coulomb * np.sign(qd) + viscous * qd + rotor * qdd) * scale
        return np.asarray(out + offset)

    encoder = 2 * np.pi / 2 ** int(rng.integers(19, 22))
    truth = Parametric(read, sigma, candidates)
    shake = float(rng.uniform(1e-6, 5e-6))
    return MovingCell(bench, motion, time, truth, encoder, shake, mass)


def tracking_error(cell: MovingCell, name: str, rng: Generator) -> tuple[Array, tuple[str, ...]]:
    """Return a following error (N, n) outside the catalogue, and the columns it depends on."""
    j = int(rng.integers(1, cell.kind.n))
    q, qd = cell.motion.at(cell.time), cell.motion.at(cell.time, 1)
    columns: tuple[str, ...]
    if name == "droop":
        shape, columns = np.cos(q[:, j] - 0.4) - 0.5 * q[:, j], (f"actual_q_{j}", f"target_q_{j}")
    elif name == "track_step":
        when = cell.time[-1] * rng.uniform(0.3, 0.7)
        shape, columns = (cell.time > when).astype(float), ("timestamp",)
    elif name == "coupled":  # a structure that swings as another joint accelerates
        other = int(rng.choice([i for i in range(cell.kind.n) if i != j]))
        shape = cell.motion.at(cell.time, 2)[:, other] * np.cos(q[:, j])
        columns = (f"actual_q_{j}", f"actual_q_{other}", f"actual_qd_{other}",
                   f"target_q_{j}", f"target_q_{other}")  # fmt: skip
    else:
        shape, columns = -(np.maximum(qd[:, j] - 0.3 * qd[:, j].max(), 0) ** 2), (f"actual_qd_{j}",)
    return _on_joint(cell, j, shape, rng), columns


def torque_error(cell: MovingCell, name: str, rng: Generator) -> tuple[Array, tuple[str, ...]]:
    """Return a torque (N, n) outside the catalogue, and the columns it depends on."""
    columns: tuple[str, ...]
    j = int(rng.integers(0, cell.kind.n))
    q, qd = cell.motion.at(cell.time), cell.motion.at(cell.time, 1)
    if name == "cogging":
        shape = np.sin(int(rng.integers(6, 40)) * q[:, j] + rng.uniform(-3, 3))
        columns: tuple[str, ...] = (f"actual_q_{j}",)
    elif name == "torque_field":
        other = int(rng.choice([i for i in range(cell.kind.n) if i != j]))
        rate, phase = rng.normal(size=(5, 2)) * 1.5, rng.uniform(-np.pi, np.pi, 5)
        shape = np.cos(q[:, [j, other]] @ rate.T + phase) @ rng.normal(size=5)
        columns = (f"actual_q_{j}", f"actual_q_{other}")
    else:
        # the amount decays in time, so both the speed and the time are true answers
        shape = qd[:, j] * (np.exp(-cell.time / 10.0) - 0.35)
        columns = (f"actual_qd_{j}", "timestamp")
    return _on_joint(cell, j, shape, rng), columns


def _on_joint(cell: MovingCell, j: int, shape: Array, rng: Generator) -> Array:
    """Return a shape put on one joint, 3 to 10 floors of that joint, its mean taken out."""
    out = np.zeros((len(cell.time), cell.kind.n))
    spread = float(np.std(shape))
    out[:, j] = shape / spread * cell.truth.sigma[j] * rng.uniform(3, 10)
    return out
