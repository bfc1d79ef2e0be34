"""Exact columns of delay, lag and dead band, where the first order does not suffice.

To first order delay and lag are both speed times time, so that a linear search confuses them, and
the residual looks like a third cause. A dead band has no derivative at all.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import MIN_DELAY_SCATTER, MIN_DELAYS
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate, named_columns
from gapbridge.core.diagnosis.selection.sample_space import CandidateFit, SampleSpace, fit
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.robust import scale_of

MIN_CHORD = 1e-3  # usual sizes of the value, from which a chord is used


def exact_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return a candidate's columns (N, k, d) at the current model ``base``.

    In tracking these are chords from zero to the current value; of a delay or a lag to the joint's
    total delay, so that both are exact there and compete on their full predictions. In torque so do
    the first moments of a light link and of a heavy load.
    """
    if observation.channel == "torque":
        return _twin_columns(observation, candidate, base)
    if observation.channel != "tracking":
        return named_columns(observation, candidate, base)
    if len(candidate.parameters) > 1:
        return named_columns(observation, candidate, ())
    return chord_columns(observation, candidate, base, chord_value(observation, candidate, base))


def _twin_columns(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> Array:
    """Return columns (N, k, d) that are exact at the value with which it replaces an alike term.

    If the model has an alike effect, these are first-order columns with Broyden's update: moments
    of inertia change with the square of a shift, and 0.1 m of a link of 0.6 kg has the first moment
    of 0.01 m of a load of 6 kg.
    """
    twins = [t for t in base if _twins(t, candidate)]
    inside = any(t.effect == candidate.family and _of_joint(t, candidate) for t in base)
    if inside or not twins or len(candidate.parameters) < 2:
        return named_columns(observation, candidate, base)
    others = [t for t in base if t not in twins]
    columns, nothing = named_columns(observation, candidate, others), observation.predict(others)
    usual = candidate.scales
    rows = (columns * usual).reshape(-1, len(usual))
    gap = (observation.measured - nothing).ravel()
    x = np.linalg.lstsq(rows, gap, rcond=1e-6)[0]
    if not x.any():
        return columns
    moved = observation.predict([*others, candidate.term(x * usual)]) - nothing
    more = moved - columns @ (x * usual)
    return np.asarray(columns + more[..., None] * (x / (x @ x) / usual))


def _twins(term: Term, candidate: Candidate) -> bool:
    own = CATALOGUE[term.effect]
    return candidate.family in own.equivalents or term.effect in candidate.effect.equivalents


def chord_value(observation: Observation, candidate: Candidate, base: Sequence[Term]) -> float:
    """Return the end value of a candidate's chord: its joint's value in the model, or a fit."""
    inside = [t.values[0] for t in base if _of_joint(t, candidate) and _alike(t, candidate)]
    parameter = candidate.parameters[0]
    if inside:
        value = float(np.sum(inside))
    else:
        others = _others(candidate, base)
        column = named_columns(observation, candidate, others)[..., 0]
        gap = observation.measured - observation.predict(others)
        value = float(np.sum(column * gap) / max(float(np.sum(column**2)), 1e-300))
    return min(max(value, parameter.lower), parameter.upper)


def chord_columns(
    observation: Observation, candidate: Candidate, base: Sequence[Term], value: float
) -> Array:
    """Return the columns (N, k, 1) of a chord from zero to ``value``."""
    others = _others(candidate, base)
    if abs(value) < MIN_CHORD * candidate.parameters[0].scale:
        return named_columns(observation, candidate, others)
    nothing = observation.predict(others)
    moved = observation.predict([*others, candidate.term(np.array([value]))]) - nothing
    return np.asarray(moved / value)[..., None]


def _others(candidate: Candidate, base: Sequence[Term]) -> list[Term]:
    """Return the other terms of the joint, which the columns of dead band depend on."""
    return [t for t in base if _of_joint(t, candidate) and not _alike(t, candidate)]


def _of_joint(term: Term, candidate: Candidate) -> bool:
    return term.site.joint == candidate.site.joint


def _alike(term: Term, candidate: Candidate) -> bool:
    """Return whether a term's value counts as the candidate's: delays add up."""
    delays = CATALOGUE[term.effect].is_delay and candidate.effect.is_delay
    return delays or term.effect == candidate.family


def shrunk_to_common_delay(values: Array, variances: Array) -> tuple[Array, Array]:
    """Return the joints' delays (n,) and variances, shrunk to the common delay of the controller.

    The prior of each delay is the median of all, with their scatter about it (at least a tenth of
    it) as 1 sigma. It determines the delay of a joint whose own is not identifiable (variance inf).
    With fewer than three known delays nothing is changed.
    """
    known = np.isfinite(variances)
    if known.sum() < MIN_DELAYS:
        return values, variances
    centre = float(np.median(values[known]))
    scatter = scale_of(values[known] - centre)
    prior = max(scatter, MIN_DELAY_SCATTER * abs(centre)) ** 2
    own = np.where(known, prior / (prior + np.where(known, variances, 0.0)), 0.0)
    return centre + own * (values - centre), np.where(known, own * variances, prior)


def one_delay(space: SampleSpace, best: CandidateFit) -> CandidateFit:
    """Return the set with one kind of delay, latency or lag, at all joints that have one.

    The kind that fits all of these joints better; a single joint hardly distinguishes them.
    """
    return min(delayed_by(space, best).values(), key=lambda f: f.score, default=best)


def delayed_by(space: SampleSpace, best: CandidateFit) -> dict[str, CandidateFit]:
    """Return, by kind of delay, the set with it at all joints that have one; {} for one joint."""
    site = {
        (k.family, k.site.joint): c for c, k in enumerate(space.candidates) if k.effect.is_delay
    }
    late = [c for c in best.chosen if space.candidates[c].effect.is_delay]
    if len(late) < 2:
        return {}
    rest = [c for c in best.chosen if c not in late]
    joints = sorted({space.candidates[c].site.joint or 0 for c in late})
    return {
        effect: fit(space, (*rest, *(site[effect, j] for j in joints)))
        for effect in dict.fromkeys(effect for effect, _ in site)
        if all((effect, j) in site for j in joints)
    }
