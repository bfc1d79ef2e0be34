"""Structural identifiability: which parameters readings of one kind determine, over all poses.

Redundant parameters are left out by rank; the others are base parameters, which include the effect
of the redundant ones (Gautier, Khalil, IEEE Trans. Robotics and Automation 6 (1990) 368).

Parameters are selected in order: one is kept if its column at random poses is independent of the
instrument's frames and of the parameters before it. A parameter that is the sum of others comes
after them in any case: an isotropic radial compliance of joint 1 equals two equal compliances of
the base, but a base that is softer about y than about x would need it with a negative one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.observables.nuisance import Nuisance
from gapbridge.core.calibration.observables.observable import Observable
from gapbridge.core.calibration.observables.predicted_readings import (
    predicted_readings,
    typical_nuisance,
    unmeasured_readings,
)
from gapbridge.core.calibration.parameters import DEFAULT, Parameters
from gapbridge.core.calibration.readings import Readings
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note, Reason

POSES = 120
VISIBLE = 3e-7  # m, rms: a usual size of a parameter must change the readings by more
MIN_INDEPENDENT = 2e-3  # share of a column that must be independent of the others
MEMBER = 0.1  # share from which a parameter is named as equivalent to a redundant one
DEFAULT_PAYLOAD, PAYLOAD_SHARE = 5.0, 0.2  # kg, of the arm's mass: where the rating is unknown


def identifiable_parameters(
    model: Model,
    effects: Sequence[str] = DEFAULT,
    *,
    observable: Observable,
    pulls: bool = False,
) -> Parameters:
    """Return the parameters of some effects, redundant ones left out, earlier effects first.

    ``effects`` are identifiers of the catalogue's position channel, for all sites or for one joint
    (``backlash_2``). ``pulls``: the session also applies horizontal forces, not only weights.
    Raises InputError for an effect that is not observable in positions.
    """
    parameters = Parameters.of_effects(model, effects)
    readings, nuisance = _random_readings(model, observable, pulls)
    J, F = _columns(parameters, observable, readings, nuisance)
    weight = np.tile(1 / observable.sigmas, len(readings))[:, None]
    J, F = J * parameters.scales * weight, F * weight
    basis = list(np.linalg.svd(F, full_matrices=False)[0].T[: np.linalg.matrix_rank(F)])
    kept: list[int] = []
    reasons = []
    limit = VISIBLE * np.sqrt(len(J))
    for i in _selection_order(parameters):
        Q = np.array(basis).reshape(-1, len(J))
        independent = J[:, i] - Q.T @ (Q @ J[:, i])
        independent -= Q.T @ (Q @ independent)  # twice, against rounding
        size, whole = float(np.linalg.norm(independent)), float(np.linalg.norm(J[:, i]))
        if size > max(limit, MIN_INDEPENDENT * whole):
            kept.append(i)
            basis.append(independent / size)
        elif whole <= limit:
            reasons.append(Note(Reason.NEVER_SHOWN, (parameters.names[i],)))
        else:
            names = [parameters.names[k] for k in kept]
            reasons.append(_redundant(parameters.names[i], J[:, i], F, J[:, kept], names))
    return parameters.part(sorted(kept), tuple(reasons))


def _selection_order(parameters: Parameters) -> list[int]:
    """Return the parameters' numbers in the order of selection."""
    named = [parameters.terms[t].effect for t, _ in parameters.place]
    order: list[int] = []
    for i, effect in enumerate(named):
        parts = CATALOGUE[effect].equals_sum_of
        order += [k for k, other in enumerate(named) if k not in order and other == parts]
        order += [] if i in order else [i]
    return order


def _columns(
    parameters: Parameters, observable: Observable, readings: Readings, nuisance: Nuisance
) -> tuple[Array, Array]:
    """Return J and F at the start of a fit; effects that need compliance, for a compliant arm."""
    J, F = observable.columns(parameters, parameters.begin, readings, nuisance)
    effects = [CATALOGUE[parameters.terms[t].effect] for t, _ in parameters.place]
    only = np.array([e.acts_through_deflection for e in effects], dtype=bool)
    soft = np.array(
        [effect.softens and not effect.has_nonlinearity for effect in effects], dtype=bool
    )
    if only.any() and soft.any():
        deflected = np.where(soft, parameters.begin + 0.3 * parameters.scales, parameters.begin)
        J[:, only] = observable.columns(parameters, deflected, readings, nuisance)[0][:, only]
    return J, F


def _redundant(name: str, column: Array, F: Array, J: Array, names: list[str]) -> Note:
    """Return what parameter ``name`` is equivalent to: others (J), the instrument's place (F)."""
    columns = np.hstack([F, J])
    share = np.linalg.lstsq(columns, column, rcond=1e-9)[0]
    reach = np.abs(share[F.shape[1] :]) * np.linalg.norm(J, axis=0) / np.linalg.norm(column)
    substitutes = tuple(names[k] for k in np.argsort(-reach)[:3] if reach[k] > MEMBER)
    if F.shape[1]:
        fixed = np.linalg.norm(F @ share[: F.shape[1]]) / np.linalg.norm(column)
        if fixed > MEMBER:
            return Note(Reason.REDUNDANT_WITH_PLACE, (name, substitutes))
    return Note(Reason.REDUNDANT, (name, substitutes))


def _random_readings(
    model: Model, observable: Observable, pulls: bool, seed: int = 0
) -> tuple[Readings, Nuisance]:
    """Return readings at random poses under random loads, with a random place of the instrument."""
    random = np.random.default_rng(seed)
    arm, n = model.arm, model.arm.n
    low, high = np.maximum(arm.limits.lower, -np.pi), np.minimum(arm.limits.upper, np.pi)
    low, high = np.minimum(low, high - 1e-3), high
    q = random.uniform(low, high, (POSES, n))
    default_payload = max(DEFAULT_PAYLOAD, PAYLOAD_SHARE * float(arm.mass.sum()))
    heaviest = arm.payload if np.isfinite(arm.payload) else default_payload
    loads = Loads(
        payload_mass=random.uniform(0, heaviest, POSES),
        payload_cog=random.normal(0, 0.05, (POSES, 3)),
        wrench=random.normal(0, 5 * heaviest, (POSES, 6)) * [1, 1, 1, 0, 0, 0] if pulls else None,
        temperature=random.uniform(15, 45, (POSES, n)),
        approach=random.choice([-1.0, 1.0], (POSES, n)),
    )
    target = np.full(POSES, int(observable.kind == "relative"))
    readings = unmeasured_readings(observable.kind, q, loads, target=target)
    nuisance = typical_nuisance(model, observable, readings, seed)
    return predicted_readings(observable, model, readings, nuisance), nuisance
