"""The parameters of a calibration: the effects and sites to estimate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arm import Arm
from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, Site, Term, effect_named
from gapbridge.core.effects.effect import typical_moment
from gapbridge.core.errors import InputError
from gapbridge.core.estimation.pose_jacobian import PoseColumns, pose_columns
from gapbridge.core.kernels.adjoint import CONVERGED
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.core.notes import Note

DEFAULT = tuple(  # effects of a calibration where none are named, in order of priority
    sorted(
        (name for name, effect in CATALOGUE.items() if effect.calibration_rank),
        key=lambda name: CATALOGUE[name].calibration_rank,
    )
)
PERIODIC_ORDERS = (1.0, 2.0)  # cycles per turn of a transmission error
PRIOR = 10.0  # usual sizes
STEP_SHARE = 0.01  # of a usual size: step of numerical derivatives


@dataclass(frozen=True)
class Parameters:
    """The p parameters of a calibration, as corrections to the nominal model."""

    nominal: Model
    terms: tuple[Term, ...]  # one a site, all values zero
    place: tuple[tuple[int, int], ...]  # (p) number of the term, number of the value in it
    names: tuple[str, ...]  # (p) as cells and reports name them
    units: tuple[str, ...]
    scales: Array  # (p,) a usual size of each
    lower: Array  # (p,) bounds; nominal plus estimated flexibility is 0 or more
    upper: Array  # (p,)
    begin: Array  # (p,) start of a fit, and linearisation point of plans
    redundant: tuple[Note, ...] = ()  # redundant parameters, and those equivalent to them

    @classmethod
    def of_effects(cls, model: Model, effects: Sequence[str] = DEFAULT) -> Parameters:
        """Return all parameters of some effects, with the redundant ones."""
        terms = tuple(_terms(model, effects))
        names, units, place = [], [], []
        numbers: list[tuple[float, float, float, float]] = []
        for t, term in enumerate(terms):
            effect = CATALOGUE[term.effect]
            nominal = _nominal_values(model, term)
            for k, parameter in enumerate(effect.parameters(model.arm, term.site)):
                place.append((t, k))
                names.append(_name(term, effect.label(term.site, parameter), parameter.name))
                units.append(parameter.unit)
                low = 0.0 if effect.softens else parameter.lower
                scale = parameter.scale
                if effect.has_nonlinearity and k == 0:
                    scale *= _lever_factor(model.arm, term.site)
                start = scale if effect.has_nonlinearity else 0.0
                bounds = low - nominal[k], parameter.upper - nominal[k]
                numbers.append((scale, *bounds, start))
        scales, lower, upper, begin = np.array(numbers).T
        return cls(
            model, terms, tuple(place), tuple(names), tuple(units), scales, lower, upper, begin
        )

    def __len__(self) -> int:
        """Return the number of parameters (p)."""
        return len(self.names)

    def part(self, kept: Sequence[int], redundant: tuple[Note, ...] = ()) -> Parameters:
        """Return the parameters ``kept``; ``redundant`` are notes on the others."""
        rows = list(kept)
        return replace(
            self,
            place=tuple(self.place[i] for i in kept),
            names=tuple(self.names[i] for i in kept),
            units=tuple(self.units[i] for i in kept),
            scales=self.scales[rows],
            lower=self.lower[rows],
            upper=self.upper[rows],
            begin=self.begin[rows],
            redundant=redundant,
        )

    def model(self, values: Array) -> Model:
        """Return the nominal model with corrections ``values`` (p,).

        They are added to the nominal model's values of the same effect at the same site.
        """
        numbers = [list(term.values) for term in self.terms]
        for (t, k), value in zip(self.place, values, strict=True):
            numbers[t][k] += float(value)
        added = {(t.effect, t.site): (t, v) for t, v in zip(self.terms, numbers, strict=True)}
        terms = []
        for term in self.nominal.terms:
            _, more = added.pop((term.effect, term.site), (term, [0.0] * len(term.values)))
            whole = [*term.values, *[0.0] * (len(more) - len(term.values))]
            sums = np.array(whole) + np.array([*more, *[0.0] * (len(whole) - len(more))])
            terms.append(term.with_values(sums))
        new = [term.with_values(np.array(v)) for term, v in added.values() if any(v)]
        return replace(self.nominal, terms=(*terms, *new))

    def pose_columns(
        self, values: Array, q: Array, loads: Loads | None, *, coordinates: int = 6,
        converged: float = CONVERGED,
    ) -> PoseColumns:  # fmt: skip
        """Return the TCP poses of ``model(values)`` at ``q`` (N, n), and how all p change them.

        See ``core.estimation.pose_jacobian``. Terms of zeros have derivatives nevertheless.
        """
        model = self.model(values)
        present = {(term.effect, term.site) for term in model.terms}
        model = model.with_terms([t for t in self.terms if (t.effect, t.site) not in present])
        numbers = {(term.effect, term.site): i for i, term in enumerate(model.terms)}
        places = [(self.terms[t], k) for t, k in self.place]
        chosen = [(numbers[term.effect, term.site], k) for term, k in places]
        return pose_columns(
            model, q, loads, chosen, STEP_SHARE * self.scales, coordinates=coordinates,
            converged=converged,
        )  # fmt: skip

    def tcp_jacobian(self, values: Array, q: Array, loads: Loads) -> Array:
        """Return d TCP position / d parameters (N, 3, p) at ``q`` (N, n), base axes."""
        columns = self.pose_columns(values, q, loads, coordinates=3)
        return np.asarray(columns.jacobian.transpose(2, 0, 1))

    @property
    def prior(self) -> Array:
        """Return 1 sigma (p,) of the weak prior at the nominal model: ten usual sizes."""
        return PRIOR * self.scales

    def approach_joints(self) -> tuple[int, ...]:
        """Return the joints (from 1) with an effect that depends on the direction of approach."""
        effects = {term.effect for term in self.terms if CATALOGUE[term.effect].depends_on_approach}
        return tuple(sorted({j for effect in effects for j in self.joints(effect)}))

    def joints(self, effect: str) -> tuple[int, ...]:
        """Return the joints (from 1) at which an effect is estimated."""
        joints = {self.terms[t].site.joint for t, _ in self.place if self.terms[t].effect == effect}
        return tuple(sorted(j for j in joints if j is not None))


def _terms(model: Model, effects: Sequence[str]) -> Iterator[Term]:
    """Yield a term of zeros for each site of each effect."""
    sites = {name: effect_sites(model, name) for name in effects}
    for name, own in sites.items():
        if not own:
            raise InputError(
                f"found {name!r}, expected a joint of this arm of {model.arm.n} joints", ("effect",)
            )
    contained = {
        (CATALOGUE[effect].replaces, site.joint) for own in sites.values() for effect, site in own
    }
    seen = set()
    for own in sites.values():
        for effect, site in own:
            if (effect, site.joint) in contained or (effect, site) in seen:
                continue
            seen.add((effect, site))
            count = len(CATALOGUE[effect].parameters(model.arm, site))
            yield Term(effect, site, (0.0,) * count)


def effect_sites(model: Model, name: str) -> list[tuple[str, Site]]:
    """Return effect and sites of ``effect`` or ``effect_JOINT``; none at a joint without it.

    Raises InputError where it is no effect, or one that positions do not show.
    """
    stem, _, number = name.rpartition("_")
    joint = int(number) if number.isdigit() and stem in CATALOGUE else None
    effect = effect_named(name if joint is None else stem)
    if not effect.calibratable:
        raise InputError(
            f"found {name!r}, expected one that measured positions show: "
            + ", ".join(e for e, member in CATALOGUE.items() if member.calibratable),
            ("effect",),
        )
    sites = [s for s in effect.sites(model.arm) if joint is None or s.joint == joint]
    if effect.periodic:
        sites = [replace(s, order=order) for s in sites for order in PERIODIC_ORDERS]
    return [(effect.identifier, site) for site in sites]


def _lever_factor(arm: Arm, site: Site) -> float:
    """Return the whole arm's usual moment over a joint's own: a wrist bends under less."""
    return typical_moment(arm) / typical_moment(arm, site.joint or 0)


def _nominal_values(model: Model, term: Term) -> Array:
    """Return the nominal model's values of the effect at the site."""
    nominal = np.zeros(len(term.values))
    for other in model.terms:
        if (other.effect, other.site) == (term.effect, term.site):
            size = min(len(nominal), len(other.values))
            nominal[:size] += other.values[:size]
    return nominal


def _name(term: Term, label: str, parameter: str) -> str:
    """Return the public name; a period has its order in it."""
    if term.site.order is None:
        return label
    return f"{term.effect}_{term.site.joint}_order{term.site.order:g}_{parameter}"
