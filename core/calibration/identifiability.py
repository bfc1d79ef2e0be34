"""Which parameters readings of one kind can identify at all, whatever the poses.

Those that no readings of the kind at hand can separate from the others are left out by rank, the
rest are base parameters: they carry what the left-out ones would add (Gautier, Khalil, IEEE Trans.
Robotics and Automation 6 (1990) 368).

Parameters are taken one after the other; one stays if it changes readings at random poses in a way
that the frames of the instrument and those before it do not. What is the sum of others is taken
after them, wherever it was named: a tilt of joint 1 that is alike in all directions stands for two
equal tilts of the base, but a base that gives way more about y than about x would need the sum and
a flexibility below zero.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import (
    empty_readings,
    predicted_readings,
    usual_nuisance,
)
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

POSES = 120
VISIBLE = 3e-7  # m, rms: a usual size that changes readings by less shows nothing
APART = 2e-3  # share of what a parameter changes that the others must leave over
MEMBER = 0.1  # share from which a parameter is named as one that stands for another
USUAL_PAYLOAD, CARRIED = 5.0, 0.2  # kg, share of its own mass: where the arm's rating is unknown


def identifiable_parameters(
    model: Model,
    effects: Sequence[str] = DEFAULT,
    *,
    observable: Observable,
    pulls: bool = False,
) -> Parameters:
    """Return the parameters of some effects, redundant ones left out, earlier effects first.

    ``effects`` are identifiers of the catalogue's position channel, for all sites or for one joint
    (``backlash_2``). ``pulls``: the session pulls at the tool sideways too, not by weights alone.
    Raises InputError for an effect that positions do not show.
    """
    parameters = Parameters.every(model, effects)
    readings, nuisance = _anywhere(model, observable, pulls)
    J, F = _columns(parameters, observable, readings, nuisance)
    weight = np.tile(1 / observable.sigmas, len(readings))[:, None]
    J, F = J * parameters.scales * weight, F * weight
    base = list(np.linalg.svd(F, full_matrices=False)[0].T[: np.linalg.matrix_rank(F)])
    kept: list[int] = []
    reasons = []
    limit = VISIBLE * np.sqrt(len(J))
    for i in _turns(parameters):
        Q = np.array(base).reshape(-1, len(J))
        left = J[:, i] - Q.T @ (Q @ J[:, i])
        left -= Q.T @ (Q @ left)  # once more: rounding of the first pass
        size, whole = float(np.linalg.norm(left)), float(np.linalg.norm(J[:, i]))
        if size > max(limit, APART * whole):
            kept.append(i)
            base.append(left / size)
        elif whole <= limit:
            reasons.append(Note(Reason.NEVER_SHOWN, (parameters.names[i],)))
        else:
            names = [parameters.names[k] for k in kept]
            reasons.append(_redundant(parameters.names[i], J[:, i], F, J[:, kept], names))
    return parameters.part(sorted(kept), tuple(reasons))


def _turns(parameters: Parameters) -> list[int]:
    """Return the parameters' numbers in the order in which they are taken."""
    named = [parameters.terms[t].effect for t, _ in parameters.place]
    turns: list[int] = []
    for i, effect in enumerate(named):
        parts = CATALOGUE[effect].sum_of
        turns += [k for k, other in enumerate(named) if k not in turns and other == parts]
        turns += [] if i in turns else [i]
    return turns


def _columns(
    parameters: Parameters, observable: Observable, readings: Readings, nuisance: Nuisance
) -> tuple[Array, Array]:
    """Return J and F where a fit begins; what only bending shows, for an arm that bends."""
    J, F = observable.columns(parameters, parameters.begin, readings, nuisance)
    effects = [CATALOGUE[parameters.terms[t].effect] for t, _ in parameters.place]
    only = np.array([effect.needs_softness for effect in effects], dtype=bool)
    soft = np.array([effect.softens and not effect.curved for effect in effects], dtype=bool)
    if only.any() and soft.any():
        bent = np.where(soft, parameters.begin + 0.3 * parameters.scales, parameters.begin)
        J[:, only] = observable.columns(parameters, bent, readings, nuisance)[0][:, only]
    return J, F


def _redundant(name: str, column: Array, F: Array, J: Array, names: list[str]) -> Note:
    """Return what acts like parameter ``name``: others (columns J), the instrument's place."""
    every = np.hstack([F, J])
    share = np.linalg.lstsq(every, column, rcond=1e-9)[0]
    reach = np.abs(share[F.shape[1] :]) * np.linalg.norm(J, axis=0) / np.linalg.norm(column)
    stand = tuple(names[k] for k in np.argsort(-reach)[:3] if reach[k] > MEMBER)
    if F.shape[1]:
        fixed = np.linalg.norm(F @ share[: F.shape[1]]) / np.linalg.norm(column)
        if fixed > MEMBER:
            return Note(Reason.REDUNDANT_WITH_PLACE, (name, stand))
    return Note(Reason.REDUNDANT, (name, stand))


def _anywhere(
    model: Model, observable: Observable, pulls: bool, seed: int = 0
) -> tuple[Readings, Nuisance]:
    """Return readings at random poses under random loads, taken by an instrument somewhere."""
    random = np.random.default_rng(seed)
    arm, n = model.arm, model.arm.n
    low, high = np.maximum(arm.limits.lower, -np.pi), np.minimum(arm.limits.upper, np.pi)
    low, high = np.minimum(low, high - 1e-3), high
    q = random.uniform(low, high, (POSES, n))
    usual = max(USUAL_PAYLOAD, CARRIED * float(arm.mass.sum()))
    heaviest = arm.payload if np.isfinite(arm.payload) else usual
    loads = Loads(
        payload_mass=random.uniform(0, heaviest, POSES),
        payload_cog=random.normal(0, 0.05, (POSES, 3)),
        wrench=random.normal(0, 5 * heaviest, (POSES, 6)) * [1, 1, 1, 0, 0, 0] if pulls else None,
        temperature=random.uniform(15, 45, (POSES, n)),
        approach=random.choice([-1.0, 1.0], (POSES, n)),
    )
    target = np.full(POSES, int(observable.kind == "relative"))
    readings = empty_readings(observable.kind, q, loads, target=target)
    nuisance = usual_nuisance(model, observable, readings, seed)
    return predicted_readings(observable, model, readings, nuisance), nuisance
