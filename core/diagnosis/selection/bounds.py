"""Bounds of the candidates' values: what the model and a new term are in sum stays physical."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gapbridge.core.diagnosis.criteria import MAX_PAYLOAD_FACTOR
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.selection.candidate import Candidate
from gapbridge.core.effects import Parameter
from gapbridge.core.load_bounds import LoadBounds
from gapbridge.core.model import Model


def bounded(candidate: Candidate, model: Model, observation: Observation) -> Candidate:
    """Return the candidate with bounds that keep the total of model and term physical.

    Values are real minus model: of what the model holds already, less is possible too. Of a
    stiffness curve the bound of the flexibility holds for the sum of its two parts.
    """
    effect, shown = candidate.effect, len(candidate.parameters)
    if effect.adds_mass:
        least, most = payload_bounds(model, observation)
        mass = replace(candidate.parameters[0], lower=least, upper=most)
        return replace(candidate, parameters=(mass, *candidate.parameters[1:]))
    if effect.adds_up:
        whole = _without_model(candidate, model)
    elif effect.flexibility:
        whole = candidate.parameters
    else:
        return candidate
    if effect.flexibility or effect.has_nonlinearity:
        axial, radial = model.compliance()
        compliance = radial if effect.flexibility == "radial" else axial
        lower = -float(compliance[candidate.site.index])
        whole = (replace(whole[0], lower=lower), *whole[1:])
    if candidate.curve is None:
        return replace(candidate, parameters=whole[:shown], whole=whole)
    first = replace(candidate.parameters[0], lower=whole[0].lower)
    return replace(candidate, parameters=(first, *candidate.parameters[1:]), whole=whole)


def _without_model(candidate: Candidate, model: Model) -> tuple[Parameter, ...]:
    """Return all parameters of a candidate's effect, bounds less what the model holds of each."""
    parameters = candidate.effect.parameters(model.arm, candidate.site)
    own = [
        t.values for t in model.terms if (t.effect, t.site) == (candidate.family, candidate.site)
    ]
    held = np.sum(own, axis=0) if own else np.zeros(len(parameters))
    return tuple(
        replace(p, lower=p.lower - float(v), upper=max(p.upper - float(v), 0.0))
        for p, v in zip(parameters, held, strict=True)
    )


def payload_bounds(model: Model, observation: Observation) -> tuple[float, float]:
    """Return bounds of a payload's error: every true mass is from 0 to the largest plausible."""
    declared = observation.payload_mass
    if declared is None:
        declared = np.array([model.payload_mass])
    least, most = (float(m) + model.added_mass for m in (declared.min(), declared.max()))
    largest = MAX_PAYLOAD_FACTOR * max(float(declared.max()), LoadBounds.of(model).rated)
    return -max(least, 0.0), max(largest - most, 0.0)
