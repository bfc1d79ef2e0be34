"""The geometry that is estimated beside the flexibilities: links, joints' zeros, the tool point.

Links of a real arm are off by tenths of a millimetre and of a milliradian. A fit that cannot move
them makes flexibilities of them (two zeros off by 1 mrad: five sigmas of a radial one), which a
diagnosis then takes back. So they are nuisances too, near nominal by a prior of an engineer's size.
Where the rows are no likelier with them they stay out: an arm that is as drawn loses no precision.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.effects import CATALOGUE, Term
from gapbridge.core.estimation.pose_jacobian import pose_columns
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

LENGTH, ANGLE = 5e-4, 1e-3  # m, rad: 1 sigma of machining and assembly
TIMES_MACHINED = (1.0, 2.0, 4.0, 8.0)  # times these, the most likely: a WAM's grid and a UR5's say
# 4, the Motoman cube 8; at 1 the WAM is pulled to nominal by as much as it gains
TOOL = 5e-3  # m, 1 sigma of a tool point that somebody typed in
SURE = 10.0  # -2 log likelihood that the geometry has to gain: chance gains as much in 1 of 600
VARIANCES = np.geomspace(1e-4, 10.0, 60)  # of the noise, in shares of what a fit leaves


@dataclass(frozen=True)
class Geometry:
    """Numbers of the geometry in a model: which, and how firmly they are held at zero."""

    first: int  # place of the first term in the model
    count: int  # of terms
    values: tuple[tuple[int, int], ...]  # (g,) term in the model, value in the term
    sigma: Array  # (g,) m or rad, 1 sigma of the prior

    @property
    def has_links(self) -> bool:
        """Return whether more than the tool point is in it."""
        return bool((self.sigma != TOOL).any())

    def columns(self, model: Model, q: Array, loads: Loads, width: int) -> Array:
        """Return d prediction / d numbers (N, width, g)."""
        found = pose_columns(model, q, loads, self.values, 0.01 * self.sigma, coordinates=width)
        return np.asarray(found.jacobian.transpose(2, 0, 1))

    def prior(self, model: Model) -> Array:
        """Return how far the numbers are from zero (g,), in their sigmas."""
        return np.array([model.terms[t].values[k] for t, k in self.values]) / self.sigma

    def moved(self, model: Model, step: Array) -> Model:
        """Return the model after a step (g,) of its numbers."""
        terms = list(model.terms)
        for (t, k), change in zip(self.values, step, strict=True):
            values = np.array(terms[t].values)
            values[k] += change
            terms[t] = terms[t].with_values(values)
        return replace(model, terms=tuple(terms))

    def written(self, model: Model) -> Model:
        """Return the model with the links as they were; a tool point alone stays where found."""
        end = self.first + self.count
        tool = model.tool_in_flange.copy()
        if not self.has_links:
            for term in model.terms[self.first : end]:
                if CATALOGUE[term.effect].corrects == "tool":
                    tool[:3, 3] += term.values[:3]
        terms = (*model.terms[: self.first], *model.terms[end:])
        return replace(model, terms=terms, tool_in_flange=tool)

    def options(self) -> Iterator[Geometry]:
        """Yield what may be off: the tool point alone, or the links too, known so or so well."""
        tool = self.sigma == TOOL
        if tool.any():
            values = tuple(v for v, own in zip(self.values, tool, strict=True) if own)
            yield replace(self, values=values, sigma=self.sigma[tool])
        for times in TIMES_MACHINED:
            yield replace(self, sigma=self.sigma * np.where(tool, 1.0, times))


def likelier(R: Array, fixed: int, cells: float, geometry: Geometry) -> Geometry | None:
    """Return the geometry under the prior that makes the rows most likely; None: likelier without.

    ``R`` is the factor of [fixed | geometry | gap], the first ones free; ``cells`` how many
    equations there were. Marginal likelihood, the noise profiled out (empirical Bayes; MacKay,
    Neural Computation 4 (1992) 415).
    """
    r = R[fixed:, -1]
    freedom, squares = cells - fixed, float(r @ r)
    if freedom <= 0 or squares <= 0:
        return None
    least, best = freedom * np.log(squares / freedom) + freedom - SURE, None
    for option in geometry.options():
        own = [geometry.values.index(value) for value in option.values]
        U, s, _ = np.linalg.svd(R[fixed:, fixed:-1][:, own] * option.sigma, full_matrices=False)
        along = (U.T @ r) ** 2
        for noise in VARIANCES * squares / freedom:
            wide = 1 + s**2 / noise
            left = squares - float(along @ (1 - 1 / wide))
            misfit = freedom * np.log(noise) + float(np.log(wide).sum()) + left / noise
            if misfit < least:
                least, best = misfit, option
    return best


def with_geometry(model: Model, tool: bool) -> tuple[Model, Geometry]:
    """Return the model with links, joints' zeros and (``tool``) tool point as numbers, at zero."""
    rest = tuple(t for t in model.terms if not CATALOGUE[t.effect].flexibility)
    soft = tuple(t for t in model.terms if CATALOGUE[t.effect].flexibility)
    terms: list[Term] = []
    values, sigma = [], []
    for identifier, effect in CATALOGUE.items():
        is_tool = effect.corrects == "tool"
        if "position" not in effect.channels:
            continue
        for site in effect.sites(model.arm):
            links = effect.together or (effect.beside_links and site.joint)
            if not (links or (is_tool and tool)):
                continue
            parameters = effect.parameters(model.arm, site)
            if is_tool:
                parameters = parameters[:3]
            place = len(rest) + len(terms)
            width = len(effect.parameters(model.arm, site))
            terms.append(Term(identifier, site, (0.0,) * width))
            values += [(place, k) for k in range(len(parameters))]
            usual = {"m": TOOL if is_tool else LENGTH, "rad": ANGLE}
            sigma += [usual[p.unit] for p in parameters]
    whole = replace(model, terms=(*rest, *terms, *soft))
    return whole, Geometry(len(rest), len(terms), tuple(values), np.array(sigma))
