"""The hierarchical compliance fit of each arm type of a fleet."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import norm

from gapbridge.bridge.document.json_text import finite
from gapbridge.bridge.fleet.drift import ChannelFigure, Drift, Figure, Outlier, significant
from gapbridge.bridge.fleet.task import Outcome, by_arm
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.effects import flexibility_names
from gapbridge.core.estimation.hierarchical import ArmFit, Scatter, SessionFit, TypeFit, fit_type
from gapbridge.core.estimation.hierarchical_evidence import Evidence

UNIT = "rad/Nm"
ARM_OUTLIER = 3.5  # scatters between arms of a type
SESSION_OUTLIER = 3.0  # variance / variance of the noise


@dataclass(frozen=True)
class FittedSession:
    """One session in the fit."""

    outcome: Outcome
    fit: SessionFit
    gap_before: float  # m, rms per coordinate, with the flexibilities of the cell
    gap_after: float  # m, with the fitted flexibilities of the arm
    gap_held_out: float  # m, with those fitted to all other sessions


@dataclass(frozen=True)
class FittedArm:
    """One arm in the fit, its sessions sorted."""

    name: str
    fit: ArmFit
    sessions: tuple[FittedSession, ...]

    @property
    def poses(self) -> int:
        """Return the number of poses used."""
        return sum(int(s.outcome.result["evidence"]["poses"]) for s in self.sessions)


@dataclass(frozen=True)
class FittedType:
    """All arms of a type."""

    name: str
    parameters: tuple[str, ...]  # (2n,)
    scatter: Scatter
    arms: tuple[FittedArm, ...]

    @property
    def has_size(self) -> Mask:
        """Return which flexibilities (2n,) exceed their own 1 sigma; others have no share."""
        std = np.sqrt(np.diag(self.scatter.covariance))
        return np.asarray(self.scatter.identifiable & (self.scatter.mean > std))

    @property
    def spread(self) -> float | None:
        """Return the median scatter between arms, as a share; None: no flexibility has a size."""
        known = self.has_size
        shares = self.scatter.between_arms[known] / self.scatter.mean[known]
        return float(np.median(shares)) if len(shares) else None


@dataclass(frozen=True)
class FleetFit:
    """The fit of a fleet."""

    types: tuple[FittedType, ...]
    drifts: tuple[Drift, ...]
    outliers: tuple[Outlier, ...]


def fit_fleet(outcomes: Sequence[Outcome]) -> FleetFit:
    """Return the hierarchical fit of every type that has a usable session."""
    kinds: dict[tuple[str, int], dict[str, list[Outcome]]] = {}
    for arm, sessions in by_arm(outcomes).items():
        for outcome in sessions:
            kind = (outcome.result["type"], outcome.result["joints"])
            kinds.setdefault(kind, {}).setdefault(arm, []).append(outcome)
    types = tuple(_type(kind[0], kinds[kind]) for kind in sorted(kinds))
    drifts = tuple(significant([d for t in types for d in _drifts(t)]))
    outliers = sorted((o for t in types for o in _outliers(t)), key=lambda o: -abs(o.deviations))
    return FleetFit(types, drifts, tuple(outliers))


def _type(name: str, arms: dict[str, list[Outcome]]) -> FittedType:
    outcomes = [o for sessions in arms.values() for o in sessions]
    number = [i for i, sessions in enumerate(arms.values()) for _ in sessions]
    evidence = [_evidence(o) for o in outcomes]
    nominal = np.median([o.result["nominal"] for o in outcomes], axis=0)
    fit = fit_type(evidence, number, nominal, float(outcomes[0].result["usual"]))
    sessions = [
        _session(o, e, fit, s, i)
        for s, (o, e, i) in enumerate(zip(outcomes, evidence, number, strict=True))
    ]
    fitted_arms, begin = [], 0
    for i, (arm, own) in enumerate(arms.items()):
        fitted_arms.append(FittedArm(arm, fit.arms[i], tuple(sessions[begin : begin + len(own)])))
        begin += len(own)
    names = flexibility_names(len(nominal) // 2)
    return FittedType(name, tuple(names), fit.scatter, tuple(fitted_arms))


def _evidence(outcome: Outcome) -> Evidence:
    fields = dict(outcome.result["evidence"])
    arrays = {k: np.array(fields[k]) for k in ("matrix", "right")}
    return Evidence(**(fields | arrays))


def _session(
    outcome: Outcome, evidence: Evidence, fit: TypeFit, session: int, arm: int
) -> FittedSession:
    def rms(flexibility: Array) -> float:
        residual = evidence.matrix @ flexibility - evidence.right
        rows = evidence.freedom + np.linalg.matrix_rank(evidence.matrix)
        return math.sqrt((float(residual @ residual) + evidence.squares) / max(rows, 1))

    one = fit.sessions[session]
    return FittedSession(
        outcome, one, rms(np.array(outcome.result["nominal"])), rms(fit.arms[arm].flexibility),
        rms(one.without),
    )  # fmt: skip


def _drifts(kind: FittedType) -> Iterator[Drift]:
    for arm in kind.arms:
        names = tuple(s.outcome.session for s in arm.sessions)
        for j, parameter in enumerate(kind.parameters):
            slope, std = float(arm.fit.drift[j]), float(arm.fit.drift_std[j])
            if math.isfinite(slope) and kind.scatter.identifiable[j]:
                yield Drift(
                    arm.name, parameter, UNIT, "session", slope, std,
                    float(2 * norm.sf(abs(slope) / std)),
                    tuple(float(i) for i in range(len(names))),
                    tuple(float(s.fit.flexibility[j]) for s in arm.sessions),
                    names,
                )  # fmt: skip


def _outliers(kind: FittedType) -> Iterator[Outlier]:
    for arm in kind.arms:
        far = np.abs(arm.fit.beside_type) > ARM_OUTLIER
        for j in np.flatnonzero(far & kind.scatter.identifiable):
            yield Outlier(
                arm.name, "", kind.parameters[j], float(arm.fit.flexibility[j]),
                float(kind.scatter.mean[j]), UNIT, float(arm.fit.beside_type[j]),
            )  # fmt: skip
        for session in arm.sessions:
            if session.fit.surprise > SESSION_OUTLIER:
                yield Outlier(
                    arm.name, session.outcome.session, ChannelFigure("position", Figure.MISFIT),
                    session.gap_after, kind.scatter.noise, "m", math.sqrt(session.fit.surprise),
                )  # fmt: skip


def flexibility_rows(fleet: FleetFit) -> Iterator[dict[str, Any]]:
    """Yield a row per flexibility of each type, arm and session."""
    for kind in fleet.types:
        type_std = np.sqrt(np.diag(kind.scatter.covariance))
        for j, parameter in enumerate(kind.parameters):
            shared = {
                "type": kind.name, "parameter": parameter, "unit": UNIT,
                "joint": j % (len(kind.parameters) // 2) + 1,
                "shown": bool(kind.scatter.identifiable[j]),
            }  # fmt: skip
            yield (
                shared
                | {"level": "type", "scatter": float(kind.scatter.between_arms[j])}
                | (_interval(kind.scatter.mean[j], type_std[j]))
            )
            for arm in kind.arms:
                yield shared | {
                    "level": "arm", "arm": arm.name, "own_share": float(arm.fit.own_share[j]),
                    "scatter": float(kind.scatter.between_sessions[j]),
                    "drift": finite(arm.fit.drift[j]), "drift_std": finite(arm.fit.drift_std[j]),
                    "drift_per": "session",
                } | _interval(arm.fit.flexibility[j], arm.fit.std[j])  # fmt: skip
                for session in arm.sessions:
                    yield shared | {
                        "level": "session", "arm": arm.name, "session": session.outcome.session,
                    } | _interval(session.fit.flexibility[j], session.fit.std[j])  # fmt: skip


def session_figures(fleet: FleetFit) -> dict[str, dict[str, Any]]:
    """Return the figures of each session, by its name."""
    return {
        s.outcome.session: {
            "outliers": s.outcome.result["evidence"]["outliers"], "noise": s.fit.noise,
            "gap_before": s.gap_before, "gap_after": s.gap_after, "gap_held_out": s.gap_held_out,
            "surprise": s.fit.surprise,
        }
        for kind in fleet.types for arm in kind.arms for s in arm.sessions
    }  # fmt: skip


def _interval(value: float, std: float) -> dict[str, float]:
    """Return a value with its 95 % interval; a flexibility is not negative."""
    return {"value": float(value), "std": float(std),
            "low": max(float(value - 1.96 * std), 0.0),
            "high": float(value + 1.96 * std)}  # fmt: skip
