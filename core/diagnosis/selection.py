"""Selection: from an observation to the terms that explain it.

Rounds of: columns at the model found so far, search, exact refit (Gauss-Newton on the whole
prediction, frames and all), wild readings looked at again; until the set stays the same.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from core.arm import Arm
from core.diagnosis.candidate import (
    Candidate,
    joint_quantity,
    named_candidates,
    named_columns,
)
from core.diagnosis.noise import Noise, estimate_noise
from core.diagnosis.observation import Observation
from core.diagnosis.search import Found, Space, children, fit, prices, screened_search
from core.diagnosis.smooth import smooth_candidates
from core.effects import CATALOGUE, Term
from core.errors import InputError
from core.model import Model

Array = NDArray[np.float64]
ROUNDS = 5
REFITS = 8
WILD_SHARE = 0.05  # of the samples: more of them is structure, not bad luck
BENDING = ("axial_compliance", "radial_compliance", "stiffness_nonlinearity",
           "link_flexibility", "base_compliance", "payload")  # fmt: skip
WILD_SIGMA = 5.0
WEAK = 100.0  # usual sizes of a parameter: how far the data may take it against nothing
KNOWN_SHARE = 0.7  # a stated repeatability is an average: less than this share of it is not assumed
RIDGE = 5.0  # usual sizes of a parameter: prior of the fit that only looks for wild readings


@dataclass(frozen=True)
class Selection:
    """What explains an observation, and the space in which it won."""

    observation: Observation  # frame as finally estimated
    space: Space  # columns at the final model; kept samples only
    found: Found
    terms: tuple[Term, ...]  # the named part, refitted exactly
    term_index: tuple[int, ...]  # candidate index of each term
    covariance: tuple[Array, ...]  # per term (d, d) of its fitted parameters
    kept: NDArray[np.bool_]  # (N,) samples that are not wild
    noise: Noise
    residual: Array  # (N, k) measured - predicted by the named terms, frame estimated along
    base: tuple[Term, ...]
    raw: Array  # (m, K) columns before the nuisance was projected out, kept samples
    raw_nuisance: Array  # (m, p)
    raw_target: Array  # (m,)

    @property
    def nuisance_basis(self) -> Array:
        """Return an orthonormal basis (m, p) of the nuisance in the sample space."""
        p = self.raw_nuisance.shape[1]
        return np.linalg.qr(self.raw_nuisance)[0] if p else self.raw_nuisance

    @property
    def used(self) -> float:
        """Return the number of fitted unknowns, nuisance included."""
        return float(self.raw_nuisance.shape[1] + sum(len(v) for v in self.found.values))

    @property
    def groups(self) -> NDArray[np.int64]:
        """Return the condition of every row of the sample space (m,)."""
        k = self.observation.measured.shape[1]
        return np.repeat(self.observation.groups[self.kept], k)


@dataclass
class _Work:
    observation: Observation
    arm: Arm
    candidates: list[Candidate]
    noise: Noise
    kept: NDArray[np.bool_]


def select(
    observation: Observation,
    model: Model,
    withheld: Iterable[str] = (),
    progress: Callable[[str], None] | None = None,
) -> Selection:
    """Return the best explanation of an observation by named effects and smooth functions."""
    arm = model.arm
    rotation = observation.measured.shape[1] > 3
    base: tuple[Term, ...] = ()
    turns = [
        float(np.ptp(observation.quantities.get(joint_quantity(observation, i), np.zeros(1))))
        / (2 * np.pi)
        for i in range(arm.n)
    ]
    kept = np.ones(len(observation.rows), dtype=bool)
    first = estimate_noise(observation, observation.measured - observation.predict(()), kept)
    work = _Work(observation, arm, [], first, kept)
    found: Found | None = None
    space: Space | None = None
    smooth = smooth_candidates(observation, arm)
    for turn in range(ROUNDS):
        if progress:
            progress(f"{observation.channel}: round {turn + 1}")
        work.candidates = [
            _bounded(c, model)
            for c in named_candidates(arm, observation.channel, withheld, rotation, base, turns)
            if _has_what_it_needs(c, observation)
        ]
        columns = [named_columns(work.observation, c, base) for c in work.candidates]
        if turn == 0:
            _look_for_wild(work, columns)
        space, raw, nuisance, target = _space(work, columns, base, smooth)
        inside = [_locate(work.candidates, t)[0] for t in base]
        best = screened_search(space, base=inside)
        if turn > 0 and not work.kept.all():
            space, raw, nuisance, target, best = _with_wild_explained(
                work, columns, base, smooth, (space, raw, nuisance, target, best)
            )
        counted, whitened_by = work.kept.copy(), work.noise
        try:
            terms, index, covariance, residual = _refit(work, space, best)
        except InputError:  # absurd flexibilities: the arm would buckle
            stiff = [c for c in best.chosen if space.candidates[c].family not in BENDING]
            best = fit(space, stiff)
            terms, index, covariance, residual = _refit(work, space, best)
        same = terms_alike(terms, base) and turn > 0
        found = best
        free = 1 - sum(len(v) for v in best.values) / space.freedom
        changed = _look_again(work, residual, free)
        if same and not changed:
            break
        base = terms
    assert space is not None and found is not None
    return Selection(
        work.observation, space, found, terms, index, covariance, counted, whitened_by,
        residual, base, raw, nuisance, target,
    )  # fmt: skip


def _bounded(candidate: Candidate, model: Model) -> Candidate:
    """Return the candidate with bounds that keep the whole model physical (flexibility >= 0)."""
    if candidate.family not in ("axial_compliance", "radial_compliance"):
        return candidate
    axial, radial = model.compliance()
    own = axial if candidate.family == "axial_compliance" else radial
    assert candidate.site.joint is not None
    lower = -float(own[candidate.site.joint - 1])
    return replace(candidate, parameters=(replace(candidate.parameters[0], lower=lower),))


def _has_what_it_needs(candidate: Candidate, observation: Observation) -> bool:
    return all(
        any(q == need or q.startswith(f"{need}_") for q in observation.quantities)
        for need in CATALOGUE[candidate.family].needs
    )


def _flat(columns: Array, work: _Work) -> Array:
    """Return (N, k, d) columns as whitened (m, d) rows of the kept samples."""
    kept = work.noise.whitener[work.kept] @ columns[work.kept]
    return np.asarray(kept.reshape(kept.shape[0] * kept.shape[1], columns.shape[-1]))


def _space(
    work: _Work,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
) -> tuple[Space, Array, Array, Array]:
    observation = work.observation
    candidates = [*work.candidates, *(c for c, _ in smooth)]
    raw = np.hstack([_flat(c, work) for c in [*columns, *(s for _, s in smooth)]])
    size = np.array([len(c.parameters) for c in candidates])
    start = np.concatenate([[0], np.cumsum(size)])
    gap = (observation.measured - observation.predict(base))[..., None]
    # what the terms already in the model explain is put back, in the linear form at hand
    for term in base:
        c, x = _locate(work.candidates, term)
        gap = gap + columns[c] @ x[:, None]
    target = _flat(gap, work)[:, 0]
    nuisance = _flat(observation.nuisance, work)
    Q = np.linalg.qr(nuisance)[0] if nuisance.shape[1] else nuisance
    X, y = raw - Q @ (Q.T @ raw), target - Q @ (Q.T @ target)
    freedom = float(len(target) - Q.shape[1])
    space = Space(
        y, X, start, tuple(candidates), prices(candidates, freedom), freedom,
        KNOWN_SHARE if observation.sigma_is_whole else work.noise.floor_share,
    )  # fmt: skip
    return space, raw, nuisance, target


def _locate(candidates: list[Candidate], term: Term) -> tuple[int, Array]:
    """Return the candidate of a term, and the term's fitted values."""
    for c, candidate in enumerate(candidates):
        if candidate.family == term.effect and candidate.site == term.site:
            if candidate.fixed != (None,) * len(term.values) and not np.allclose(
                [f for f in candidate.fixed if f is not None],
                [v for f, v in zip(candidate.fixed, term.values, strict=True) if f is not None],
            ):
                continue
            free = [v for f, v in zip(candidate.fixed, term.values, strict=True) if f is None]
            return c, np.array(free)
    raise KeyError(term)


def _refit(
    work: _Work, space: Space, found: Found
) -> tuple[tuple[Term, ...], tuple[int, ...], tuple[Array, ...], Array]:
    """Refit the named terms exactly, smooth ones kept linear; moves the frame along."""
    index = tuple(c for c in found.chosen if space.candidates[c].named)
    freed = {c: _freed(work.arm, space.candidates[c]) for c in index}
    smooth = [c for c in found.chosen if not space.candidates[c].named]
    x = [
        np.array(space.candidates[c].term(v).values)[: len(freed[c].parameters)]
        for c, v in zip(found.chosen, found.values, strict=True)
        if c in index
    ]
    extra = space.columns(smooth)
    covariance: list[Array] = []
    for _ in range(REFITS):
        observation = work.observation
        terms = tuple(freed[c].term(v) for c, v in zip(index, x, strict=True))
        gap = observation.measured - observation.predict(terms)
        blocks = []
        for k, c in enumerate(index):
            others = terms[:k] + terms[k + 1 :]
            blocks.append(_flat(_slope(work, freed[c], x[k], others), work))
        nuisance = _flat(observation.nuisance, work)
        A = np.hstack([*blocks, extra, nuisance])
        b = _flat(gap[..., None], work)[:, 0]
        unit = 1 / np.sqrt(np.einsum("ij,ij->j", A, A) + 1e-300)
        pull, towards = _pull(freed, index, x, A.shape[1])
        step = np.linalg.lstsq(
            np.vstack([A, pull]) * unit, np.concatenate([b, towards]), rcond=1e-9
        )[0] * unit  # fmt: skip
        sizes = [len(v) for v in x]
        cuts = np.cumsum([*sizes, extra.shape[1]])
        parts = np.split(step, cuts)
        moved, share = 0.0, _share(work, freed, index, x, parts, A, b)
        for k in range(len(x)):
            x[k] = _within(freed[index[k]], x[k] + share * parts[k])
            scale = np.array([p.scale for p in freed[index[k]].parameters])
            moved = max(moved, float(np.abs(parts[k] / scale).max()))
        if observation.rebase is not None:
            work.observation = observation.rebase(parts[-1])
        residual_ss = float(np.sum((b - A @ step) ** 2))
        variance = max(residual_ss / max(len(b) - A.shape[1], 1), space.floor)
        inverse = np.linalg.pinv((A * unit).T @ (A * unit), rcond=1e-13, hermitian=True)
        whole = inverse * np.outer(unit, unit) * variance
        begin = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        covariance = [whole[i:j, i:j] for i, j in itertools.pairwise(begin)]
        if moved < 1e-6:
            break
    terms = tuple(freed[c].term(v) for c, v in zip(index, x, strict=True))
    gap = work.observation.measured - work.observation.predict(terms)
    nuisance = work.observation.nuisance
    if nuisance.shape[2]:
        A = np.hstack([extra, _flat(nuisance, work)])
        b = _flat(gap[..., None], work)[:, 0]
        solution = np.linalg.lstsq(A, b, rcond=1e-12)[0]
        gap = gap - nuisance @ solution[extra.shape[1] :]
    return terms, index, tuple(covariance), gap


def _pull(
    freed: dict[int, Candidate], index: tuple[int, ...], x: list[Array], width: int
) -> tuple[Array, Array]:
    """Return rows (k, width) and targets that pull what the data leave open towards zero.

    So weak (many usual sizes) that only combinations without any trace in the data feel it: lengths
    along parallel axes, which otherwise run off against each other.
    """
    usual = np.array([WEAK * p.scale for c in index for p in freed[c].parameters])
    rows = np.zeros((len(usual), width))
    rows[np.arange(len(usual)), np.arange(len(usual))] = 1 / usual
    return rows, -np.concatenate([*x, np.zeros(0)]) / usual


def _share(
    work: _Work, freed: dict[int, Candidate], index: tuple[int, ...], x: list[Array],
    parts: list[Array], A: Array, b: Array,
) -> float:  # fmt: skip
    """Return the share of a Gauss-Newton step to go: less than all where it would overshoot."""
    if not index:
        return 1.0
    linear = A[:, sum(len(v) for v in x) :]  # smooth terms and nuisance, refitted for each trial
    Q = np.linalg.qr(linear)[0] if linear.shape[1] else linear

    def left(share: float) -> float:
        terms = [freed[c].term(_within(freed[c], v + share * part))
                 for c, v, part in zip(index, x, parts, strict=False)]  # fmt: skip
        try:
            gap = work.observation.measured - work.observation.predict(terms)
        except InputError:
            return float("inf")
        r = _flat(gap[..., None], work)[:, 0]
        r = r - Q @ (Q.T @ r)
        return float(r @ r)

    now = left(0.0)
    for share in (1.0, 0.5, 0.25, 0.1, 0.03):
        if left(share) <= now:
            return share
    return 0.0


def _freed(arm: Arm, candidate: Candidate) -> Candidate:
    """Return the candidate with what its columns held fixed (a softening) fitted too."""
    if candidate.family != "stiffness_nonlinearity":
        return candidate
    parameters = CATALOGUE[candidate.family].parameters(arm, candidate.site)
    return replace(candidate, parameters=parameters, fixed=(None,) * len(parameters), curve=None)


def _slope(work: _Work, candidate: Candidate, x: Array, others: tuple[Term, ...]) -> Array:
    """Return d prediction / d parameter (N, k, d) at the term's present values."""
    columns = []
    for k, parameter in enumerate(candidate.parameters):
        h = np.zeros(len(x))
        h[k] = 1e-2 * parameter.scale
        ahead = work.observation.predict([*others, candidate.term(x + h)])
        behind = work.observation.predict([*others, candidate.term(x - h)])
        columns.append((ahead - behind) / (2 * h[k]))
    return np.stack(columns, axis=-1)


def _within(candidate: Candidate, x: Array) -> Array:
    lower = np.array([p.lower for p in candidate.parameters])
    upper = np.array([p.upper for p in candidate.parameters])
    return np.asarray(np.clip(x, lower, upper))


def _look_for_wild(work: _Work, columns: list[Array]) -> None:
    """Mark wild readings before anything is searched: by a fit that can explain nearly anything."""
    observation = work.observation
    gap = observation.measured - observation.predict(())
    N, k = gap.shape
    usual, parts = [], []
    for c, block in zip(work.candidates, columns, strict=True):
        if c.family == "transmission_error" and (c.site.order or 0) > 3:
            continue
        parts.append(block)
        usual += [p.scale for p in c.parameters]
    A = np.concatenate(parts, axis=2) * np.array(usual) if parts else np.zeros((N, k, 0))
    prior = np.concatenate(
        [np.full(A.shape[2], 1 / RIDGE), np.zeros(observation.nuisance.shape[2])]
    )
    A = np.concatenate([A, observation.nuisance], axis=2)
    weight, r, used = np.ones(N), gap, 0.0
    for step in range(8):
        W = work.noise.whitener * np.sqrt(weight)[:, None, None]
        M, rhs = (W @ A).reshape(N * k, -1), (W @ gap[..., None]).ravel()
        G = M.T @ M
        inverse = np.linalg.pinv(G + np.diag(prior**2), rcond=1e-14, hermitian=True)
        r = gap - A @ (inverse @ (M.T @ rhs))
        used = float(np.trace(inverse @ G))
        work.kept = _keep(work, r)
        if step in (2, 5, 7):
            work.noise = estimate_noise(observation, r, work.kept, 1 - used / (N * k))
        distance = _distance(work, r)
        weight = 1 / (1 + (distance / 2) ** 2)
    work.kept = _keep(work, r)


def _distance(work: _Work, residual: Array) -> Array:
    """Return how many standard deviations (rms over coordinates) each sample is off (N,)."""
    white = (work.noise.whitener @ residual[..., None])[..., 0]
    distance = np.sqrt(np.mean(white**2, axis=1))
    usual = np.sqrt(np.median(white**2) / 0.4549)
    return np.asarray(distance / max(usual, 1e-12))


def _keep(work: _Work, residual: Array) -> NDArray[np.bool_]:
    """Return the samples to keep: all but the few wildest, and only if they are few."""
    distance = _distance(work, residual)
    wild = np.flatnonzero(distance > WILD_SIGMA)
    limit = int(np.ceil(WILD_SHARE * len(residual)))
    kept = np.ones(len(residual), dtype=bool)
    kept[wild[np.argsort(-distance[wild])][:limit]] = False
    return kept


def _with_wild_explained(
    work: _Work,
    columns: list[Array],
    base: tuple[Term, ...],
    smooth: list[tuple[Candidate, Array]],
    known: tuple[Space, Array, Array, Array, Found],
) -> tuple[Space, Array, Array, Array, Found]:
    """Take wild readings back in where one local or smooth function makes them ordinary.

    A chipped tooth or a knocked instrument looks like a few wild readings; bad luck has no place.
    """
    kept, found = work.kept, known[-1]
    work.kept = np.ones_like(kept)
    space, raw, nuisance, target = _space(work, columns, base, smooth)
    gain = children(space, found.chosen, 12)
    k = work.observation.measured.shape[1]
    for _, c in gain:
        if space.candidates[c].named:
            continue
        trial = fit(space, (*found.chosen, c))
        left = space.y - space.columns(trial.chosen) @ np.concatenate(trial.values)
        distance = np.sqrt(np.mean(left.reshape(-1, k) ** 2, axis=1))
        if (distance[~kept] < WILD_SIGMA * np.median(distance)).all():
            return space, raw, nuisance, target, trial
    work.kept = kept
    return known


def _look_again(work: _Work, residual: Array, free: float) -> bool:
    """Judge noise and wild readings by the best explanation; returns whether those changed."""
    kept = _keep(work, residual)
    changed = bool((kept != work.kept).any())
    work.kept = kept
    work.noise = estimate_noise(work.observation, residual, kept, free)
    return changed


def terms_alike(a: tuple[Term, ...], b: tuple[Term, ...]) -> bool:
    """Return whether two sets of terms accuse the same effects at the same sites."""
    return {(t.effect, t.site) for t in a} == {(t.effect, t.site) for t in b}
