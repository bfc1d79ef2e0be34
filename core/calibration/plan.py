"""The plan of a calibration session: poses, loads and approaches in the order of travel."""

from __future__ import annotations

from dataclasses import dataclass

from gapbridge.core.arrays import Array
from gapbridge.core.notes import Note


@dataclass(frozen=True)
class Payload:
    """A test load on the flange."""

    mass: float  # kg
    cog: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, flange axes
    name: str = ""


@dataclass(frozen=True)
class PlannedPose:
    """One stop of the session."""

    number: int  # from 0; repeats of a pose share it
    q: Array  # (n,) rad
    load: int  # number in Plan.loads
    approach: Array  # (n,) sign of each joint's motion into the pose: -1, +1; 0 where it is free
    station: int = 0  # number of the instrument's place
    target: int = 0  # number of the ball or reflector on the tool
    held_out: bool = False  # measured to verify, never to fit
    repeat: int = 0  # 0 for the first visit


@dataclass(frozen=True)
class Expectation:
    """Expected standard deviations of a planned session."""

    names: tuple[str, ...]  # of the parameters, as reports name them
    units: tuple[str, ...]
    std: Array  # (p,) 1 sigma; inf where not identifiable
    prior: Array  # (p,) usual size of each before the session
    tcp_std: float  # m, rms over the workspace of the predicted TCP's 1 sigma (3D)
    tcp_std_worst: float  # m, the largest over the workspace


@dataclass(frozen=True)
class Plan:
    """A whole session."""

    loads: tuple[Payload, ...]
    poses: tuple[PlannedPose, ...]  # in the order of travel, one load after the other
    expected: Expectation
    bought: tuple[tuple[int, float], ...]  # number of fitted poses, tcp_std (m) with them
    travel: float  # s, motion alone
    notes: tuple[Note, ...] = ()
