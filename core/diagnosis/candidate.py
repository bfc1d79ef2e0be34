"""Candidates: everything that may stand behind a gap, each with its columns.

A *named* candidate is an effect of the catalogue at one site; a *smooth* one is an unnamed function
of one quantity (CONTRACT: what wins there is ``unexplained``). Columns are derivatives of the
channel's whole prediction, by central differences, at the model found so far.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from core.arm import Arm
from core.diagnosis.observation import Observation
from core.effects import CATALOGUE, Effect, Parameter, Site, Term

Array = NDArray[np.float64]
STEP = 1e-2  # of a parameter's usual scale, for central differences
WHOLE_ORDERS = 128  # cycles a turn that are looked through one by one
CYCLES = 1.5  # of a periodic line over the joint's range, at least
HALF_ORDERS = 40  # up to here also the halves
SOFTENING = (0.1, 0.5, 2.0, 6.0, 20.0, 60.0, 200.0, 800.0)  # (typical moment / M0)^2 that a bent stiffness curve starts from


@dataclass(frozen=True)
class Candidate:
    """One hypothesis: columns (m, d) in the flattened, whitened sample space."""

    family: str  # the effect's identifier, or 'smooth'
    site: Site
    parameters: tuple[Parameter, ...]
    fixed: tuple[float | None, ...]  # per parameter of the effect: None = fitted
    quantity: str = ""  # what a smooth candidate depends on
    target: str = ""  # and what it moves

    @property
    def named(self) -> bool:
        """Return whether this is a member of the catalogue."""
        return self.family != "smooth"

    def term(self, x: Array) -> Term:
        """Return the term with fitted values ``x`` (d,)."""
        free = iter(float(v) for v in x)
        values = tuple(next(free) if f is None else f for f in self.fixed)
        return Term(self.family, self.site, values)


def named_candidates(
    arm: Arm,
    channel: str,
    withheld: Iterable[str] = (),
    with_rotation: bool = False,
    base: Sequence[Term] = (),
    turns: Sequence[float] = (),
) -> list[Candidate]:
    """Return the catalogue's members for a channel, at every site of the arm.

    What ``base`` holds already comes with its own period or curve. ``turns`` (n,) says how many
    turns each joint's poses span.
    """
    found = []
    for identifier, effect in CATALOGUE.items():
        if channel not in effect.channels or identifier in set(withheld):
            continue
        for site in effect.sites(arm):
            inside = [t for t in base if t.effect == identifier and t.site.joint == site.joint]
            found += _at(arm, effect, site, with_rotation, inside, turns)
    return found


def _at(
    arm: Arm, effect: Effect, site: Site, with_rotation: bool, inside: Sequence[Term],
    turns: Sequence[float],
) -> list[Candidate]:
    parameters = effect.parameters(arm, site)
    free: tuple[float | None, ...] = (None,) * len(parameters)
    if effect.identifier == "transmission_error":
        orders = sorted(
            set(np.arange(1, WHOLE_ORDERS + 1).astype(float))
            | set(np.arange(1, 2 * HALF_ORDERS + 1) / 2)
            | {t.site.order for t in inside if t.site.order is not None}
        )
        # a period has to be seen more than once: slower waves are no period but a shape
        least = max(1.0, CYCLES / max(turns[site.joint - 1], 1e-6)) if site.joint else 1.0
        return [
            Candidate(effect.identifier, Site(site.joint, float(o)), parameters, free)
            for o in orders
            if o >= least
        ]
    if effect.identifier == "stiffness_nonlinearity" and not inside:
        return [
            Candidate(effect.identifier, site, parameters[:1], (None, s * parameters[1].scale))
            for s in SOFTENING
        ]
    if effect.identifier == "tool_frame" and not with_rotation:
        return [Candidate(effect.identifier, site, parameters[:3], (None,) * 3 + (0.0,) * 3)]
    return [Candidate(effect.identifier, site, parameters, free)]


def named_columns(
    observation: Observation, candidate: Candidate, base: Sequence[Term]
) -> Array:
    """Return d prediction / d parameter (N, k, d), ``base`` terms already in the model."""
    J = observation.joint_columns
    if candidate.family == "transmission_error" and J is not None:
        assert candidate.site.joint is not None and candidate.site.order is not None
        i = candidate.site.joint - 1
        phase = candidate.site.order * observation.quantities[joint_quantity(observation, i)]
        return np.stack([J[:, :, i] * np.sin(phase)[:, None], J[:, :, i] * np.cos(phase)[:, None]],
                        axis=-1)  # fmt: skip
    columns = []
    for k, parameter in enumerate(candidate.parameters):
        h = STEP * parameter.scale
        step = np.zeros(len(candidate.parameters))
        step[k] = h
        ahead = observation.predict([*base, candidate.term(step)])
        behind = observation.predict([*base, candidate.term(-step)])
        columns.append((ahead - behind) / (2 * h))
    return np.stack(columns, axis=-1)


def joint_quantity(observation: Observation, i: int) -> str:
    """Return the name of the column with joint i's angle."""
    name = f"actual_q_{i}"
    return name if name in observation.quantities else f"target_q_{i}"
