"""The judgement: what is accused, what is withdrawn, and what is said to be unexplained.

A set of terms is believed only if nothing structured is left and no unnamed function is needed
beside it. Otherwise the accusations are weak: they may be what the catalogue can do to imitate a
cause that it does not hold. Then only what much data makes sure of is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.diagnosis.held_out import HeldOut
from core.diagnosis.residual_structure import dependence, structure_p_value
from core.diagnosis.selection.bent import not_bent
from core.diagnosis.selection.local_search import rivals
from core.diagnosis.selection.problem import Found, Space, fit
from core.diagnosis.selection.selection import Selection

Array = NDArray[np.float64]
SURE = 0.002  # probability below which a leftover counts as structured
MANY = 150  # samples from which causes are kept beside a structured leftover
ACCOMPLICES = 4  # effects that one short log can hardly hold at once
TIE = 7.0  # score within which another explanation counts as equally good
STATED = 1.5  # times the stated noise: beyond, more than noise is left
REPEATED = 1.6  # times the scatter of repeated poses
ENOUGH_REPEATS = 30  # degrees of freedom from which repeats are a measure of the noise
USUAL = 1.2e-4  # m, one coordinate: a worse repeatability than that is none
INSTRUMENTS = 5.0  # times the instrument's sigma, for coarse instruments
HINT = 0.05  # probability from which a coordinate is suspect once structure is sure
TRACE = 0.01  # share of an unnamed function from which a coordinate has it
TOUCH = 0.1  # share of a cause that acts on a coordinate: more than that touches it
LEAST = 0.002  # share of the held-out gap that a cause has to take beside a leftover


@dataclass(frozen=True)
class Judgement:
    """The verdict on one channel."""

    accused: tuple[int, ...]  # positions in ``selection.terms``
    structured: bool
    p_value: float | None
    depends_on: tuple[
        tuple[str, float], ...
    ]  # quantity, held-out share of what is not accounted for
    ties: dict[int, tuple[str, ...]]  # position -> effects that would do as well
    withdrawn: tuple[tuple[int, str], ...]  # position, reason


def judge(selection: Selection) -> Judgement:
    """Return the judgement of a selection."""
    space, found = selection.space, selection.found
    smooth = [c for c in found.chosen if not space.candidates[c].named]
    withdrawn: list[tuple[int, str]] = []
    believed = [c for c in found.chosen if space.candidates[c].named]
    straight = not_bent(selection.terms, selection.covariance)
    for position in straight:
        withdrawn.append((position, "its curve cannot be told from a straight line"))
        believed.remove(selection.term_index[position])
    nuisance = selection.nuisance_basis
    p_value = structure_p_value(space, nuisance, found.chosen)
    effects = {space.candidates[c].family for c in believed}
    sure = SURE * (1 + len(believed))  # the more is accused, the less may be left
    structured = bool(smooth) or p_value < sure or bool(straight) or _too_much_left(selection)
    samples = int(selection.kept.sum())
    if samples < MANY and len(effects) >= ACCOMPLICES:
        structured = True
    if structured:
        weak = _weak(selection, believed, smooth)
        why = "structure is left beside it"
        withdrawn += [(selection.term_index.index(c), why) for c in weak]
        believed = [c for c in believed if c not in weak]
    accused = tuple(selection.term_index.index(c) for c in believed)
    depends: tuple[tuple[str, float], ...] = ()
    if structured or not accused:
        depends = tuple(dependence(space, nuisance, believed, selection.groups))
    return Judgement(
        accused, structured, p_value, depends, _ties(space, found, selection, accused),
        tuple(withdrawn),
    )  # fmt: skip


def holding(selection: Selection, judgement: Judgement, held: HeldOut) -> Judgement:
    """Return the judgement without accusations that do not hold on samples the fit did not see.

    Only where structure is left beside causes: there a training score is no witness.
    """
    if not (judgement.structured and judgement.accused and held.possible):
        return judgement
    accused, withdrawn = list(judgement.accused), list(judgement.withdrawn)
    while accused:
        index = {p: selection.term_index[p] for p in accused}
        whole = held.rms(list(index.values()))
        rest = {p: held.rms([c for o, c in index.items() if o != p]) for p in accused}
        worst = min(accused, key=lambda p: rest[p])
        if rest[worst] > whole * (1 + LEAST):
            break
        accused.remove(worst)
        withdrawn.append((worst, "it does not hold on samples that its fit did not see"))
    return replace(judgement, accused=tuple(accused), withdrawn=tuple(withdrawn))


def _weak(selection: Selection, believed: list[int], smooth: list[int]) -> list[int]:
    """Return the accusations that structure beside them makes weak.

    A large log of poses tells many causes apart, so there what holds on unseen poses may stay
    (``holding``). Where each joint has a coordinate of its own, causes stay that touch none of the
    coordinates with structure.
    """
    space, observation = selection.space, selection.observation
    if observation.channel == "position" and selection.kept.sum() >= MANY:
        return []
    k = observation.measured.shape[1]
    coordinate = np.arange(len(space.y)) % k
    if observation.channel not in ("tracking", "torque"):
        return believed
    nuisance, chosen = selection.nuisance_basis, selection.found.chosen
    touched = {c: _touches(space, c, coordinate, k) for c in (*believed, *smooth)}
    bad = np.zeros(k, dtype=bool)
    for c in smooth:
        bad |= touched[c] > TRACE
    for j in range(k):
        bad[j] |= structure_p_value(space, nuisance, chosen, rows=coordinate == j) < HINT
    if not bad.any():
        return believed
    return [
        c for c in believed
        if touched[c][bad].sum() > TOUCH or space.candidates[c].effect.felt_by_all
    ]  # fmt: skip


def _touches(space: Space, c: int, coordinate: NDArray[np.int64], k: int) -> Array:
    """Return how the size of a candidate's columns is shared among the coordinates (k,)."""
    block = space.columns([c])
    size = np.bincount(coordinate, np.einsum("ij,ij->i", block, block), k)
    return np.asarray(size / max(float(size.sum()), 1e-300))


def _too_much_left(selection: Selection) -> bool:
    """Return whether more is left than noise can be: than repeats, or a repeatability, allow."""
    observation, k = selection.observation, selection.observation.measured.shape[1]
    if observation.sigma <= 0 or observation.channel != "position":
        return False
    left = selection.residual[selection.kept][:, : min(k, 3)]
    variance = float(np.mean(left**2)) * left.size / max(left.size - selection.used, 1)
    if observation.sigma_is_whole:
        return variance > (STATED * observation.sigma) ** 2
    pure, freedom = pure_error(left, observation.groups[selection.kept])
    if freedom >= ENOUGH_REPEATS:
        return variance > REPEATED**2 * max(pure, observation.sigma**2)
    return variance > max(USUAL, INSTRUMENTS * observation.sigma) ** 2


def pure_error(left: Array, groups: NDArray[np.int64]) -> tuple[float, int]:
    """Return the variance of one coordinate among repeats of a pose, and its degrees of freedom.

    Repeats under other loads count too: the leftover of a good model does not depend on them.
    """
    total, freedom = 0.0, 0
    for group in np.unique(groups):
        part = left[groups == group]
        if len(part) > 1:
            total += float(np.sum((part - part.mean(axis=0)) ** 2))
            freedom += (len(part) - 1) * left.shape[1]
    return total / max(freedom, 1), freedom


def _ties(
    space: Space, found: Found, selection: Selection, accused: tuple[int, ...]
) -> dict[int, tuple[str, ...]]:
    told: dict[int, tuple[str, ...]] = {}
    for position in accused:
        c = selection.term_index[position]
        own = space.candidates[c].family
        names: list[str] = []
        for _, other in rivals(space, found, c, TIE):
            family = space.candidates[other].family
            if not space.candidates[other].named or family in (own, *names):
                continue
            if space.candidates[other].effect.contains != own:  # a curve holds its line: no rival
                names.append(family)
        told[position] = tuple(names)
    return told


def without(selection: Selection, dropped: set[int]) -> Found:
    """Return the fit of the chosen set less some candidates."""
    return fit(selection.space, tuple(c for c in selection.found.chosen if c not in dropped))
