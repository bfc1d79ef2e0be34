"""Geometry parameters as nuisances of the compliance fit: links, joint zeros, the tool point.

Real links deviate by tenths of a millimetre and of a milliradian, which would bias the
flexibilities (two zeros off by 1 mrad: five sigmas of a radial one). The prior of the deviations
has the size of manufacturing tolerances. They are included only if they increase the likelihood, so
that an arm with nominal geometry loses no precision.
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

LENGTH_STD, ANGLE_STD = 5e-4, 1e-3  # m, rad: 1 sigma of machining and assembly
PRIOR_FACTORS = (1.0, 2.0, 4.0, 8.0)  # on them, by likelihood: WAM and UR5 give 4, a Motoman 8
TOOL_STD = 5e-3  # m, 1 sigma of a tool point entered by hand
MIN_LIKELIHOOD_GAIN = 10.0  # of -2 log likelihood: by chance in 1 of 600
NOISE_SHARES = np.geomspace(1e-4, 10.0, 60)  # noise variance over that of the residual


@dataclass(frozen=True)
class Geometry:
    """Geometry parameters in a model, and their prior about zero."""

    first: int  # index of the first term in the model
    count: int  # of terms
    values: tuple[tuple[int, int], ...]  # (g,) term in the model, value in the term
    sigma: Array  # (g,) m or rad, 1 sigma of the prior

    @property
    def has_links(self) -> bool:
        """Return whether it includes more than the tool point."""
        return bool((self.sigma != TOOL_STD).any())

    def columns(self, model: Model, q: Array, loads: Loads, width: int) -> Array:
        """Return d prediction / d parameters (N, width, g)."""
        columns = pose_columns(model, q, loads, self.values, 0.01 * self.sigma, coordinates=width)
        return np.asarray(columns.jacobian.transpose(2, 0, 1))

    def prior(self, model: Model) -> Array:
        """Return the parameters over their prior sigmas (g,)."""
        return np.array([model.terms[t].values[k] for t, k in self.values]) / self.sigma

    def moved(self, model: Model, step: Array) -> Model:
        """Return the model after a step (g,) of its parameters."""
        terms = list(model.terms)
        for (t, k), change in zip(self.values, step, strict=True):
            values = np.array(terms[t].values)
            values[k] += change
            terms[t] = terms[t].with_values(values)
        return replace(model, terms=tuple(terms))

    def written(self, model: Model) -> Model:
        """Return the model with nominal links; a tool point is kept if it is the only parameter."""
        end = self.first + self.count
        tool = model.tool_in_flange.copy()
        if not self.has_links:
            for term in model.terms[self.first : end]:
                if CATALOGUE[term.effect].replaces_cell_value == "tool":
                    tool[:3, 3] += term.values[:3]
        terms = (*model.terms[: self.first], *model.terms[end:])
        return replace(model, terms=terms, tool_in_flange=tool)

    def options(self) -> Iterator[Geometry]:
        """Yield the hypotheses: only the tool point, or links with each prior factor."""
        tool = self.sigma == TOOL_STD
        if tool.any():
            values = tuple(v for v, is_tool in zip(self.values, tool, strict=True) if is_tool)
            yield replace(self, values=values, sigma=self.sigma[tool])
        for factor in PRIOR_FACTORS:
            yield replace(self, sigma=self.sigma * np.where(tool, 1.0, factor))


def most_likely_geometry(R: Array, fixed: int, cells: float, geometry: Geometry) -> Geometry | None:
    """Return the geometry with the most likely prior; None: likelier without geometry.

    ``R`` is the factor of [fixed | geometry | gap], where ``fixed`` columns have no prior;
    ``cells`` is the number of equations. Marginal likelihood, noise profiled out (empirical Bayes;
    MacKay, Neural Computation 4 (1992) 415).
    """
    r = R[fixed:, -1]
    freedom, squares = cells - fixed, float(r @ r)
    if freedom <= 0 or squares <= 0:
        return None
    least, best = freedom * np.log(squares / freedom) + freedom - MIN_LIKELIHOOD_GAIN, None
    for option in geometry.options():
        columns = [geometry.values.index(value) for value in option.values]
        U, s, _ = np.linalg.svd(R[fixed:, fixed:-1][:, columns] * option.sigma, full_matrices=False)
        projected = (U.T @ r) ** 2
        for noise in NOISE_SHARES * squares / freedom:
            variance_ratio = 1 + s**2 / noise
            remaining = squares - float(projected @ (1 - 1 / variance_ratio))
            misfit = (
                freedom * np.log(noise) + float(np.log(variance_ratio).sum()) + remaining / noise
            )
            if misfit < least:
                least, best = misfit, option
    return best


def with_geometry(model: Model, tool: bool) -> tuple[Model, Geometry]:
    """Return the model with terms of zeros for links, joint zeros and (``tool``) tool point."""
    other = tuple(t for t in model.terms if not CATALOGUE[t.effect].flexibility)
    flexible = tuple(t for t in model.terms if CATALOGUE[t.effect].flexibility)
    terms: list[Term] = []
    values, sigma = [], []
    for identifier, effect in CATALOGUE.items():
        is_tool = effect.replaces_cell_value == "tool"
        if "position" not in effect.channels:
            continue
        for site in effect.sites(model.arm):
            links = effect.estimated_as_whole or (effect.estimated_with_links and site.joint)
            if not (links or (is_tool and tool)):
                continue
            parameters = effect.parameters(model.arm, site)
            if is_tool:
                parameters = parameters[:3]
            index = len(other) + len(terms)
            width = len(effect.parameters(model.arm, site))
            terms.append(Term(identifier, site, (0.0,) * width))
            values += [(index, k) for k in range(len(parameters))]
            std = {"m": TOOL_STD if is_tool else LENGTH_STD, "rad": ANGLE_STD}
            sigma += [std[p.unit] for p in parameters]
    with_terms = replace(model, terms=(*other, *terms, *flexible))
    return with_terms, Geometry(len(other), len(terms), tuple(values), np.array(sigma))
