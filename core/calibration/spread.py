"""The standard deviation of predicted positions, from the covariance of fitted parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.parameters import Parameters
from gapbridge.core.effects import CATALOGUE, Term, flexibility_names, split_name
from gapbridge.core.errors import EquilibriumError, InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses

FIRST_ORDER = np.inf  # m/rad: no second round of the adjoints, which would change some thousandths
BLOCK = 20_000  # rows at a time, so that memory does not grow with them
FEW = 2048  # the same of products with the covariance


@dataclass(frozen=True)
class Spread:
    """Names of fitted parameters (p), as calibrations have them, and their covariance (p, p), SI.

    ``Spread.none()`` where nothing is known.
    """

    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def none(cls) -> Spread:
        """Return no parameters."""
        return cls((), np.zeros((0, 0)))

    @classmethod
    def of_fit(cls, shown: NDArray[np.bool_], covariance: Array) -> Spread:
        """Return the flexibilities that a fit has ``shown`` (2n,), axial then radial."""
        names = flexibility_names(len(shown) // 2)
        rows = np.flatnonzero(shown)
        return cls(tuple(names[i] for i in rows), covariance[np.ix_(rows, rows)])

    @classmethod
    def of_terms(cls, model: Model, terms: Sequence[Term], covariance: Sequence[Array]) -> Spread:
        """Return the numbers of terms, each with its own covariance (d, d).

        Terms that a calibration does not fit (a slip, a torque) are left out.
        """
        names: list[str] = []
        blocks: list[Array] = []
        for term, own in zip(terms, covariance, strict=True):
            if not CATALOGUE[term.effect].calibratable:
                continue
            every = Parameters.every(model, [term.effect])
            at = {(every.terms[t].site, k): name for (t, k), name in
                  zip(every.place, every.names, strict=True)}  # fmt: skip
            known = [k for k in range(len(own)) if (term.site, k) in at]
            names += [at[term.site, k] for k in known]
            blocks.append(own[np.ix_(known, known)])
        return cls(tuple(names), _blocks(blocks))

    def beside(self, earlier: Spread) -> Spread:
        """Return these parameters, and those of an earlier fit that this one left as they were."""
        kept = [i for i, name in enumerate(earlier.names) if name not in self.names]
        names = (*self.names, *(earlier.names[i] for i in kept))
        return Spread(names, _blocks([self.covariance, earlier.covariance[np.ix_(kept, kept)]]))

    def sigma_columns(
        self, model: Model, q: Array, loads: Loads | None, known: Sequence[Term]
    ) -> Array:
        """Return 1 sigma (N, 6, r) of the poses, m and rad, base axes, along r directions.

        Those of what the fit left open, the numbers of the terms ``known`` left out. Raises as
        ``poses_and_std``.
        """
        every = parameters_named(model, self.names, "provenance")
        own = {(term.effect, term.site) for term in known}
        sites = [(every.terms[t].effect, every.terms[t].site) for t, _ in every.place]
        rest = [i for i, site in enumerate(sites) if site not in own]
        value, V = np.linalg.eigh(self.covariance[np.ix_(rest, rest)])
        found = every.part(rest).pose_columns(np.zeros(len(rest)), q, loads)
        root = V * np.sqrt(np.maximum(value, 0.0))
        return np.asarray(found.jacobian.transpose(2, 0, 1) @ root)

    def poses_and_std(self, model: Model, q: Array, loads: Loads | None) -> tuple[Poses, Array]:
        """Return the poses, and 1 sigma (N, 3), m, base axes, of positions; one parameter at least.

        The parameters' part alone. Raises InputError where a parameter is none of the model's arm,
        or a row has no equilibrium.
        """
        parameters = parameters_named(model, self.names, "provenance")
        position, rotation = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        std = np.empty((len(q), 3))
        for begin in range(0, len(q), BLOCK):
            rows = slice(begin, begin + BLOCK)
            try:
                found = parameters.pose_columns(
                    np.zeros(len(parameters)), q[rows], None if loads is None else loads[rows],
                    coordinates=3, converged=FIRST_ORDER,
                )  # fmt: skip
            except EquilibriumError as error:
                raise EquilibriumError(begin + error.row) from None
            position[rows], rotation[rows] = found.poses.position, found.poses.rotation
            self._spread_of(found.jacobian, std[rows])
        return Poses(position, rotation), std

    def _spread_of(self, jacobian: Array, std: Array) -> None:
        """Write 1 sigma (N, 3) of positions that change by ``jacobian`` (3, p, N)."""
        for begin in range(0, len(std), FEW):  # temporaries that stay in the processor's cache
            rows = slice(begin, begin + FEW)
            for k, J in enumerate(jacobian[:, :, rows]):
                square = np.einsum("pn,pn->n", J, self.covariance @ J)
                std[rows, k] = np.sqrt(np.maximum(square, 0.0))


def parameters_named(model: Model, names: Sequence[str], where: str) -> Parameters:
    """Return the parameters with these names, to be found beyond ``model``.

    Raises InputError, beginning with ``where``, for a name that its arm does not have.
    """
    every = Parameters.every(model, effects_of(names))
    at = {name: i for i, name in enumerate(every.names)}
    missing = [name for name in names if name not in at]
    if missing:
        raise InputError(
            f"{where}: found parameter {missing[0]!r}, expected one of this cell's arm"
        )
    return every.part([at[name] for name in names])


def effects_of(names: Sequence[str]) -> tuple[str, ...]:
    """Return the effects that parameters with these names belong to, each once."""
    found = []
    for name in names:
        parts = split_name(name)
        if parts is None:
            raise InputError(f"calibration: found parameter {name!r}, expected one of an effect")
        found.append(parts.effect)
    return tuple(dict.fromkeys(found))


def _blocks(blocks: Sequence[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    whole, begin = np.zeros((size, size)), 0
    for block in blocks:
        end = begin + len(block)
        whole[begin:end, begin:end] = block
        begin = end
    return whole
