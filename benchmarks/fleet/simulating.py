"""Fleets made up: arms of a type that scatter about it, their sessions, what a tracker reads.

The truth is the blind benchmark's mechanics, which shares nothing with the model that is fitted.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.blind.arms import UR10E
from benchmarks.blind.measuring import Instrument, read_arm
from benchmarks.blind.mechanics import Array, RealArm, turn
from benchmarks.blind.session import Plan, draw_session
from benchmarks.blind.writing import write_cell, write_log

KIND = UR10E
TOOL = np.array([0.03, -0.02, KIND.tool])


@dataclass(frozen=True)
class Habits:
    """How arms of the type and their sessions scatter, and what the tracker does."""

    between_arms: float = 0.25  # 1 sigma of the logarithm
    between_sessions: float = 0.03
    sigma: float = 2.0e-5  # m, of the tracker
    joint_sigma: float = 1.5e-5  # rad, the arm's repeatability
    pulled: float = 0.2  # share of the poses with a pull


@dataclass(frozen=True)
class TrueArm:
    """An arm as it is."""

    axial: Array  # (n,) rad/Nm
    radial: Array

    @property
    def flexibility(self) -> Array:
        """Return all (2n,): axial, then radial."""
        return np.concatenate([self.axial, self.radial])

    def scattered(self, by: float, rng: Generator) -> TrueArm:
        """Return one like it."""
        n = len(self.axial)
        return TrueArm(
            self.axial * np.exp(rng.normal(0, by, n)), self.radial * np.exp(rng.normal(0, by, n))
        )


TYPE = TrueArm(np.array(KIND.axial), np.array(KIND.radial))


def real_arm(true: TrueArm | None) -> RealArm:
    """Return the arm for the mechanics; None: the rigid one of the drawing."""
    zero = np.zeros(KIND.n)
    return RealArm(
        KIND.rows, TOOL, np.eye(3), zero if true is None else true.axial,
        zero if true is None else true.radial, np.array([0.0, 0.0, -9.80665]),
    )  # fmt: skip


def columns(
    true: TrueArm, poses: int, habits: Habits, rng: Generator, tracker: Instrument | None = None
) -> dict[str, Array]:
    """Return the columns of a session's log."""
    plan = Plan(poses=poses, blocks=min(4, poses), pulled=habits.pulled)
    session = draw_session(KIND, plan, rng)
    position, _ = read_arm(real_arm(true), session, tracker or instrument(habits, rng), rng)
    return {
        "timestamp": session.time, "actual_q": session.q, "payload": session.payload_mass,
        "payload_cog": session.payload_cog, "actual_TCP_force": session.tcp_wrench,
        "joint_temperatures": np.full(session.q.shape, 25.0), "approach": session.approach,
        "measured_position": position,
    }  # fmt: skip


def instrument(habits: Habits, rng: Generator) -> Instrument:
    """Return a tracker that stands somewhere; nobody has registered it."""
    where = turn(rng.normal(0, 0.6, (1, 3)))[0]
    return Instrument(False, where, rng.normal(0, 1.5, 3), habits.sigma, None, habits.joint_sigma)


def write_type_cell(folder: Path) -> Path:
    """Write the cell of the type: the drawing, rigid."""
    folder.mkdir(parents=True, exist_ok=True)
    metrology = {"registered": False, "sigma": 2.0e-5}
    write_cell(folder, KIND, real_arm(None), (0.0, np.zeros(3)), metrology)
    return folder / "cell.yaml"


Story = Callable[[TrueArm, int, int], TrueArm]  # (arm, its number, session) -> as it is then


def write_fleet(
    folder: Path,
    poses: Sequence[Sequence[int]],
    seed: int,
    habits: Habits | None = None,
    story: Story | None = None,
) -> tuple[Path, list[TrueArm]]:
    """Write a fleet: a folder per arm, a log per session of so many poses; returns the arms."""
    habits = habits or Habits()
    rng = np.random.default_rng(seed)
    cell = write_type_cell(folder)
    arms = []
    digits = len(str(len(poses)))
    for number, sessions in enumerate(poses):
        arm = TYPE.scattered(habits.between_arms, rng)
        arms.append(arm)
        place = folder / "logs" / f"arm{number + 1:0{digits}d}"
        place.mkdir(parents=True, exist_ok=True)
        for session, count in enumerate(sessions):
            now = arm.scattered(habits.between_sessions, rng)
            now = story(now, number, session) if story else now
            write_log(place / f"session-{session + 1:02d}.csv", columns(now, count, habits, rng))
    return cell, arms
