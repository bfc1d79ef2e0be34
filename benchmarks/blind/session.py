"""A measuring session: poses, loads in blocks, pulls, warming joints, approaches."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.random import Generator
from scipy.cluster.vq import kmeans2

from benchmarks.blind.arms import ArmKind
from benchmarks.blind.mechanics import Array, Session

REGIONS = 24  # of joint space, of which whole ones are kept back


@dataclass(frozen=True)
class Plan:
    """How a session is laid out; the poor ones leave something unexcited."""

    poses: int = 70
    blocks: int = 4  # payloads, one after the other
    pulled: float = 0.25  # share of the poses with an outside pull
    both_sides: bool = True  # joints come from either side
    approach_written: bool = True  # else it must be read from row differences
    moving: tuple[int, ...] | None = None  # joints (from 0) that move at all
    span: float = 1.0  # share of each joint's range that is used
    warming: float = 20.0  # K
    reference_temperature: float = 25.0
    clusters: int = 0  # poses lie in so many small clusters; 0: all over the range
    sessions: int = 1  # the tracker stands elsewhere in each
    doubled: bool = False  # every row stands twice in the log
    beyond: int = 0  # poses kept back: whole regions of joint space that the log does not show


def parted(session: Session, plan: Plan, rng: Generator) -> tuple[Session, Session]:
    """Return the session without whole regions of joint space, and the poses of those."""
    scale = np.maximum(np.std(session.q, axis=0), 1e-9)
    _, region = kmeans2(session.q / scale, REGIONS, minit="++", rng=rng)
    away = np.zeros(len(session.q), dtype=bool)
    for own in rng.permutation(REGIONS):
        if away.sum() >= plan.beyond:
            break
        away |= region == own
    kept, fresh = (_rows(session, rows) for rows in (~away, away))
    if plan.both_sides and not plan.approach_written:  # it is read from the rows that are there
        approach = np.sign(np.diff(kept.q, axis=0, prepend=kept.q[:1]))
        overshoot = np.where(approach == 0, 0.0, 0.05)
        kept = replace(kept, approach=approach, from_where=kept.q - overshoot * approach)
    return kept, fresh


def _rows(session: Session, rows: Array) -> Session:
    return Session(**{f.name: getattr(session, f.name)[rows] for f in fields(session)})


def draw_session(kind: ArmKind, plan: Plan, rng: Generator) -> Session:
    """Return a session of ``plan.poses`` poses."""
    q = _angles(kind, plan, rng)
    count, n = q.shape
    time = np.cumsum(rng.uniform(15.0, 45.0, count))
    mass, cog = _payloads(kind, plan, rng)
    if not plan.both_sides:
        approach = np.ones((count, n))
    elif plan.approach_written:
        approach = rng.choice([-1.0, 1.0], size=(count, n))
    else:
        approach = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    overshoot = np.where(approach == 0, 0.0, 0.05)
    return Session(
        time=time,
        q=q,
        payload_mass=mass,
        payload_cog=cog,
        tcp_wrench=_pulls(kind, plan, rng),
        temperature=_temperatures(time, n, plan, rng),
        approach=approach,
        from_where=q - overshoot * approach,
    )


def _angles(kind: ArmKind, plan: Plan, rng: Generator) -> Array:
    low, high = np.array(kind.low), np.array(kind.high)
    middle, half = (low + high) / 2, (high - low) / 2
    if plan.span < 1.0:
        middle = middle + (1 - plan.span) * half * rng.uniform(-0.8, 0.8, kind.n)
        half = half * plan.span
    # spread evenly: each joint's range in as many strata as poses
    strata = np.argsort(rng.random((plan.poses, kind.n)), axis=0)
    unit = (strata + rng.random((plan.poses, kind.n))) / plan.poses
    q = middle + half * (2 * unit - 1)
    if plan.clusters:
        centres = middle + half * rng.uniform(-0.9, 0.9, (plan.clusters, kind.n))
        near = centres[rng.integers(0, plan.clusters, plan.poses)]
        q = np.clip(near + half * rng.normal(0, 0.06, q.shape), low, high)
    if plan.moving is not None:
        still = [i for i in range(kind.n) if i not in plan.moving]
        q[:, still] = middle[still] + half[still] * rng.uniform(-0.5, 0.5, len(still))
    return np.asarray(np.round(q, 8))


def _payloads(kind: ArmKind, plan: Plan, rng: Generator) -> tuple[Array, Array]:
    levels = (
        kind.rated * np.linspace(0.05, 0.95, plan.blocks)
        if plan.blocks > 1
        else np.array([kind.rated * 0.5])
    )
    levels = np.round(rng.permutation(levels) * rng.uniform(0.9, 1.05), 3)
    lever = 0.35 * kind.tool
    cogs = np.column_stack([
        rng.uniform(-0.4, 0.4, plan.blocks) * lever,
        rng.uniform(-0.4, 0.4, plan.blocks) * lever,
        rng.uniform(0.3, 1.2, plan.blocks) * lever,
    ]).round(4)  # fmt: skip
    block = np.arange(plan.poses) * plan.blocks // plan.poses
    return levels[block], cogs[block]


def _pulls(kind: ArmKind, plan: Plan, rng: Generator) -> Array:
    out = np.zeros((plan.poses, 6))
    pulled = rng.random(plan.poses) < plan.pulled
    count = int(pulled.sum())
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    out[pulled, :3] = direction * kind.pull * rng.uniform(0.4, 1.4, count)[:, None]
    out[pulled, 3:] = rng.normal(size=(count, 3)) * kind.pull * 0.04
    return out.round(3)


def _temperatures(time: Array, n: int, plan: Plan, rng: Generator) -> Array:
    start = rng.uniform(19.0, 24.0)
    rise = plan.warming * rng.uniform(0.5, 1.5, n)
    pace = time[-1] * rng.uniform(0.2, 0.8, n)
    warm = start + rise * (1 - np.exp(-(time[:, None] - time[0]) / pace))
    return np.asarray((warm + rng.normal(0, 0.1, warm.shape)).round(1))


def play(session: Session, joint: int, gap: float) -> Array:
    """Return where a joint with play stands, minus its encoder (N,): a play operator with memory.

    The encoder sits on the motor; the link rests against one flank of the gap until the motor has
    crossed it. Each pose is reached from ``from_where``; the session starts in mid-gap.
    """
    at = session.q[0, joint]
    out = np.empty(len(session.q))
    for k, (start, stop) in enumerate(
        zip(session.from_where[:, joint], session.q[:, joint], strict=True)
    ):
        for motor in (start, stop):
            at = min(max(at, motor - gap / 2), motor + gap / 2)
        out[k] = at - stop
    return out
