"""Separation: the measurements that would decide what these data leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.neighbours import rivals
from core.diagnosis.space import fit
from core.effects import CATALOGUE, Site, Term
from core.errors import InputError
from core.loads import Loads
from core.log import Log
from core.model import Model

if TYPE_CHECKING:
    from core.diagnosis.diagnosis import ChannelDiagnosis

Array = NDArray[np.float64]
POSES = 160
EACH = 2  # measurements proposed per open question
TIE = 7.0


@dataclass(frozen=True)
class Measurement:
    """One pose and load worth measuring."""

    q: tuple[float, ...]  # rad
    payload: float  # kg
    separates: tuple[str, ...]
    expected_gain: float  # distance of the rivals' predictions there, in standard deviations
    approach: tuple[int, ...] | None = None  # last motion of each joint, where it matters


def next_measurements(
    model: Model, log: Log, channels: Sequence[ChannelDiagnosis], seed: int = 0
) -> tuple[Measurement, ...]:
    """Return poses and loads, within the joint limits, that decide ties or excite the silent."""
    told: list[Measurement] = []
    for channel in channels:
        if channel.channel != "position":
            continue
        q, loads = _trials(model, log, seed)
        sigma = channel.noise_floor_rms or channel.selection.observation.sigma or 1e-5
        for names, difference in _questions(model, channel, q, loads):
            gain = np.linalg.norm(difference, axis=1) / sigma
            told += _best(model, q, loads, names, gain)
    return tuple(told)


def _trials(model: Model, log: Log, seed: int) -> tuple[Array, Loads]:
    rng = np.random.default_rng(seed)
    low = np.maximum(model.arm.limits.lower, -np.pi)
    high = np.minimum(model.arm.limits.upper, np.pi)
    q = rng.uniform(low, high, (POSES, model.arm.n))
    rated = model.arm.payload if np.isfinite(model.arm.payload) else 0.0
    seen = log.get("payload")
    most = max(rated, model.payload_mass, 0.0 if seen is None else float(np.nanmax(seen)))
    masses = np.array([0.0, 0.5, 1.0])[rng.integers(0, 3, POSES)] * most
    cog = np.tile(model.payload_cog, (POSES, 1))
    temperature = np.full((POSES, model.arm.n), model.reference_temperature + 15.0)
    approach = rng.choice([-1.0, 1.0], (POSES, model.arm.n))
    return q, Loads(payload_mass=masses, payload_cog=cog, temperature=temperature,
                    approach=approach)  # fmt: skip


def _questions(
    model: Model, channel: ChannelDiagnosis, q: Array, loads: Loads
) -> list[tuple[tuple[str, ...], Array]]:
    """Return open questions: effects to be told apart, and how their predictions differ (N, 3)."""
    selection = channel.selection
    asked: list[tuple[tuple[str, ...], Array]] = []
    for position in channel.judgement.accused:
        own = selection.term_index[position]
        told: set[str] = set()
        for _, other in rivals(selection.space, selection.found, own, TIE):
            candidate = selection.space.candidates[other]
            family = selection.terms[position].effect
            if not candidate.named or candidate.family in told | {family}:
                continue
            told.add(candidate.family)
            rest = tuple(c for c in selection.found.chosen if c != own)
            swapped = fit(selection.space, (*rest, other))
            difference = _difference(
                model, selection.terms[position], candidate.term(swapped.values[-1]), q, loads
            )
            if difference is not None:
                asked.append(((family, candidate.family), difference))
    for considered in channel.considered:
        if not considered.excited:
            difference = _usual(model, considered.effect, q, loads)
            if difference is not None:
                asked.append(((considered.effect,), difference))
    return asked


def _difference(model: Model, one: Term, other: Term, q: Array, loads: Loads) -> Array | None:
    try:
        a = model.with_terms([one]).predict(q, loads).position
        b = model.with_terms([other]).predict(q, loads).position
    except InputError:
        return None
    return np.asarray(a - b)


def _usual(model: Model, effect: str, q: Array, loads: Loads) -> Array | None:
    """Return what the effect of usual size would do (N, 3), at its first site that shows."""
    member = CATALOGUE[effect]
    for site in member.sites(model.arm):
        place = Site(site.joint, 1.0 if effect == "transmission_error" else None)
        values = tuple(p.scale for p in member.parameters(model.arm, place))
        moved = _difference(model, Term(effect, place, values), Term(effect, place, (0.0,) * len(
            values)), q, loads)  # fmt: skip
        if moved is not None and float(np.abs(moved).max()) > 1e-7:
            return moved
    return None


def _best(
    model: Model, q: Array, loads: Loads, names: tuple[str, ...], gain: Array
) -> list[Measurement]:
    told: list[Measurement] = []
    for r in np.argsort(-gain):
        far = all(np.abs(q[r] - np.array(m.q)).max() > 0.5 for m in told)
        if gain[r] > 0 and far:
            assert loads.payload_mass is not None and loads.approach is not None
            approach = tuple(int(v) for v in loads.approach[r]) if "backlash" in names else None
            told.append(
                Measurement(
                    tuple(float(v) for v in q[r]),
                    float(loads.payload_mass[r]),
                    names,
                    float(gain[r]),
                    approach,
                )
            )
        if len(told) == EACH:
            break
    return told
