"""The standard deviation of predicted positions, from the covariance of fitted parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.calibration.parameters import Parameters, effect_sites
from gapbridge.core.effects import CATALOGUE, Term, flexibility_names, split_name
from gapbridge.core.errors import EquilibriumError, InputError
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model, Poses

FIRST_ORDER = np.inf  # m/rad: one round of the adjoints; a second changes some thousandths
BLOCK_ROWS = 20_000  # rows at a time, to bound the memory
CACHED_ROWS = 2048  # rows at a time of products with the covariance, to fit the CPU cache


@dataclass(frozen=True)
class Spread:
    """Names of fitted parameters (p), and their covariance (p, p), SI; maybe of none."""

    names: tuple[str, ...]
    covariance: Array

    @classmethod
    def none(cls) -> Spread:
        """Return no parameters."""
        return cls((), np.zeros((0, 0)))

    @classmethod
    def of_fit(cls, shown: NDArray[np.bool_], covariance: Array) -> Spread:
        """Return the identifiable flexibilities (``shown``, 2n) of a fit, axial then radial."""
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
        for term, covariance_of_term in zip(terms, covariance, strict=True):
            if not CATALOGUE[term.effect].calibratable:
                continue
            parameters = Parameters.of_effects(model, [term.effect])
            index = {(parameters.terms[t].site, k): name for (t, k), name in
                  zip(parameters.place, parameters.names, strict=True)}  # fmt: skip
            known = [k for k in range(len(covariance_of_term)) if (term.site, k) in index]
            names += [index[term.site, k] for k in known]
            blocks.append(covariance_of_term[np.ix_(known, known)])
        return cls(tuple(names), _block_diagonal(blocks))

    def beside(self, earlier: Spread) -> Spread:
        """Return these parameters, and those of an earlier fit that are not among them."""
        kept = [i for i, name in enumerate(earlier.names) if name not in self.names]
        names = (*self.names, *(earlier.names[i] for i in kept))
        blocks = [self.covariance, earlier.covariance[np.ix_(kept, kept)]]
        return Spread(names, _block_diagonal(blocks))

    def sigma_columns(
        self, model: Model, q: Array, loads: Loads | None, known: Sequence[Term]
    ) -> Array:
        """Return 1 sigma (N, 6, r) of poses, m and rad, base axes, along r principal directions.

        The parameters of the terms ``known`` are excluded. Raises as ``poses_and_std``.
        """
        parameters = parameters_named(model, self.names, "provenance")
        excluded = {(term.effect, term.site) for term in known}
        terms = [parameters.terms[t] for t, _ in parameters.place]
        others = [i for i, t in enumerate(terms) if (t.effect, t.site) not in excluded]
        value, V = np.linalg.eigh(self.covariance[np.ix_(others, others)])
        columns = parameters.part(others).pose_columns(np.zeros(len(others)), q, loads)
        root = V * np.sqrt(np.maximum(value, 0.0))
        return np.asarray(columns.jacobian.transpose(2, 0, 1) @ root)

    def poses_and_std(self, model: Model, q: Array, loads: Loads | None) -> tuple[Poses, Array]:
        """Return the poses, and 1 sigma (N, 3), m, base axes, of positions, due to the parameters.

        At least one parameter. Raises InputError where the model's arm lacks a parameter, or a row
        has no equilibrium.
        """
        parameters = parameters_named(model, self.names, "provenance")
        position, rotation = np.empty((len(q), 3)), np.empty((len(q), 3, 3))
        std = np.empty((len(q), 3))
        for begin in range(0, len(q), BLOCK_ROWS):
            rows = slice(begin, begin + BLOCK_ROWS)
            try:
                columns = parameters.pose_columns(
                    np.zeros(len(parameters)), q[rows], None if loads is None else loads[rows],
                    coordinates=3, converged=FIRST_ORDER,
                )  # fmt: skip
            except EquilibriumError as error:
                raise EquilibriumError(begin + error.row) from None
            position[rows], rotation[rows] = columns.poses.position, columns.poses.rotation
            self._write_std(columns.jacobian, std[rows])
        return Poses(position, rotation), std

    def _write_std(self, jacobian: Array, std: Array) -> None:
        """Write 1 sigma (N, 3) of positions that change by ``jacobian`` (3, p, N)."""
        for begin in range(0, len(std), CACHED_ROWS):
            rows = slice(begin, begin + CACHED_ROWS)
            for k, J in enumerate(jacobian[:, :, rows]):
                square = np.einsum("pn,pn->n", J, self.covariance @ J)
                std[rows, k] = np.sqrt(np.maximum(square, 0.0))


def parameters_named(model: Model, names: Sequence[str], where: str) -> Parameters:
    """Return the parameters with these names, as corrections to ``model``.

    Raises InputError with the keys of a name in ``where`` that its arm does not have.
    """
    # each at its own joint: a stiffness curve stands instead of that joint's flexibility only
    effects = [e for e in effects_of(names, where) if effect_sites(model, e)]
    parameters = Parameters.of_effects(model, effects) if effects else None
    known = parameters.names if parameters is not None else ()
    for i, name in enumerate(names):
        if name not in known:
            raise InputError(
                f"found {name!r}, expected a parameter of this cell's arm", (where, "parameters", i)
            )
    assert parameters is not None
    return parameters.part([known.index(name) for name in names])


def effects_of(names: Sequence[str], where: str = "calibration") -> tuple[str, ...]:
    """Return the effects, with their joint, that parameters with these names belong to, each once.

    Raises InputError with the keys of a name in ``where`` that belongs to none.
    """
    effects = []
    for i, name in enumerate(names):
        parts = split_name(name)
        if parts is None or not CATALOGUE[parts.effect].calibratable:
            raise InputError(
                f"found {name!r}, expected a parameter of an effect that positions show",
                (where, "parameters", i),
            )
        effects.append(parts.effect if parts.joint is None else f"{parts.effect}_{parts.joint}")
    return tuple(dict.fromkeys(effects))


def _block_diagonal(blocks: Sequence[Array]) -> Array:
    size = sum(len(block) for block in blocks)
    whole, begin = np.zeros((size, size)), 0
    for block in blocks:
        end = begin + len(block)
        whole[begin:end, begin:end] = block
        begin = end
    return whole
