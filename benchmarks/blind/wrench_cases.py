"""The flange sensor at rest: weights and pulls in flange axes, and what ails the sensor."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from benchmarks.blind.bench import Bench, draw_bench
from benchmarks.blind.mechanics import Array, cross, turn
from benchmarks.blind.parametric import Candidate, Parametric, Place, Values
from benchmarks.blind.session import Plan

EFFECTS = ("ft_bias", "ft_drift", "ft_gain", "ft_misalignment", "payload", "payload_cog")
OUTSIDE = ("ft_hose", "ft_step", "ft_overload")
REMAINDERS = ("ft_field",)
AXES = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True)
class WrenchCell:
    """A cell with a flange sensor and a session in it."""

    bench: Bench
    truth: Parametric
    saturating: bool  # how a drift goes: it settles, or it does not


def draw_wrench_cell(rng: Generator, plan: Plan) -> WrenchCell:
    """Return a random cell with a flange sensor."""
    bench = draw_bench(rng, plan, with_rotation=False)
    rated = bench.kind.rated
    noise = rated * 9.8 * rng.uniform(1e-3, 4e-3)
    lever = bench.kind.tool
    sigma = np.array([noise] * 3 + [noise * lever * rng.uniform(0.3, 0.8)] * 3)
    saturating = bool(rng.random() < 0.3)
    span = float(np.ptp(bench.session.time))
    names = {e: tuple(f"{e}_{a}" for a in AXES) for e in ("ft_bias", "ft_drift", "ft_gain")}
    candidates: dict[Place, Candidate] = {
        ("ft_bias", None): Candidate(names["ft_bias"], 3 * sigma, 100),
        ("ft_drift", None): Candidate(names["ft_drift"], 5 * sigma / span, 100),
        ("ft_gain", None): Candidate(names["ft_gain"], np.full(6, 0.02), 12),
        ("ft_misalignment", None): Candidate(
            tuple(f"ft_misalignment_{k}" for k in ("rx", "ry", "rz")), np.full(3, 0.02), 12
        ),
        ("payload", None): Candidate(("payload",), np.array([0.03 * rated]), 15),
        ("payload_cog", None): Candidate(
            tuple(f"payload_cog_{k}" for k in "xyz"), np.full(3, 0.1 * bench.kind.tool), 15
        ),
    }
    return WrenchCell(bench, Parametric(_reader(bench, saturating), sigma, candidates), saturating)


def flange_wrench(bench: Bench, more_payload: float, shift: Array) -> Array:
    """Return what the load does to the flange (N, 6), flange axes, about the flange origin.

    Its centre of gravity is ``shift`` (3,) m off, flange axes.
    """
    session, rotation = bench.session, bench.model.flange_rotation
    mass = (session.payload_mass + more_payload)[:, None]
    weight = np.einsum("nji,j->ni", rotation, bench.nominal.gravity) * mass
    pull = np.einsum("nji,nj->ni", rotation, session.tcp_wrench[:, :3])
    couple = np.einsum("nji,nj->ni", rotation, session.tcp_wrench[:, 3:])
    lever = np.tile(bench.nominal.tool_position, (len(mass), 1))
    torque = cross(session.payload_cog + shift, weight) + cross(lever, pull) + couple
    return np.column_stack([weight + pull, torque])


def _reader(bench: Bench, saturating: bool) -> Callable[[Values], Array]:
    time = bench.session.time - bench.session.time[0]
    pace = time[-1] / 3
    drifted = pace * (1 - np.exp(-time / pace)) if saturating else time
    zero = np.zeros(6)

    def read(values: Values) -> Array:
        shift = values.get(("payload_cog", None), zero)[:3]
        wrench = flange_wrench(bench, float(values.get(("payload", None), zero)[0]), shift)
        base_rotation = values.get(("ft_misalignment", None), zero)[:3]
        back = turn(base_rotation[None])[
            0
        ]  # the sensor's axes in the flange: readings are seen from them
        wrench = np.column_stack([wrench[:, :3] @ back, wrench[:, 3:] @ back])
        wrench = wrench * (1 + values.get(("ft_gain", None), zero))
        rate = values.get(("ft_drift", None), zero)
        return np.asarray(wrench + values.get(("ft_bias", None), zero) + drifted[:, None] * rate)

    return read


def outside_error(cell: WrenchCell, name: str, rng: Generator) -> tuple[Array, tuple[str, ...]]:
    """Return a reading error (N, 6) outside the catalogue, 4 to 10 floors, and its columns."""
    session, n = cell.bench.session, cell.bench.kind.n
    way = rng.normal(size=6) * cell.truth.sigma
    columns: tuple[str, ...]
    if name == "ft_hose":
        j = n - int(rng.integers(1, 4))
        start = np.quantile(session.q[:, j], rng.uniform(0.2, 0.5))
        shape, columns = np.maximum(session.q[:, j] - start, 0.0), (f"actual_q_{j}",)
    elif name == "ft_step":
        when = np.quantile(session.time, rng.uniform(0.3, 0.7))
        shape, columns = (session.time > when).astype(float), ("timestamp",)
    elif name == "ft_field":  # a loom that winds up on two wrist joints
        j, k = n - 2, n - 1
        rate, phase = rng.normal(size=(5, 2)) * 1.2, rng.uniform(-np.pi, np.pi, 5)
        shape = np.cos(session.q[:, [j, k]] @ rate.T + phase) @ rng.normal(size=5)
        columns = (f"actual_q_{j}", f"actual_q_{k}")
    else:
        deflected = session.payload_mass / cell.bench.kind.rated
        shape, columns = -(deflected**3), ("payload",)
    error = shape[:, None] * way
    centred = error - error.mean(axis=0)
    floors = float(np.sqrt(np.mean((centred / cell.truth.sigma) ** 2)))
    return error * rng.uniform(4, 10) / floors, columns
