"""Which effects keep their value when the residual structure is modelled by unnamed functions.

A real arm may have an unknown effect besides known ones, and effects of the catalogue can imitate
an unknown one. So all unnamed functions that the residual calls for are fitted together with the
effects. An effect is stable if its value remains significant and nearly the same, in every region
of the log. The weakest is removed first; the unnamed functions are then chosen again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array, Mask
from gapbridge.core.diagnosis.criteria import (
    BATCH_REMOVAL_ROWS,
    BATCH_REMOVAL_STRENGTH,
    CLOSED_SHARE,
    CLOSED_SHARE_IN_WORST_PART,
    CONTAINED_SHARE,
    DEGENERATE,
    DOMINANT_SHARE,
    EXTRA_PARAMETER_WEIGHT,
    LINKS_GAIN,
    LINKS_OVER_SET,
    MAX_SHARE_IN_UNNAMED,
    MAX_UNNAMED,
    MAX_VALUE_RATIO,
    MIN_SIGMAS_OF_FURTHER_JOINTS,
    MIN_SIGMAS_WITH_UNNAMED,
    STAND_IN_GAIN,
)
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.regions import parts, regions
from gapbridge.core.diagnosis.selection.candidate import Candidate, target_of
from gapbridge.core.diagnosis.selection.delay_columns import shrunk_to_common_delay
from gapbridge.core.diagnosis.selection.refit import UnnamedPart
from gapbridge.core.diagnosis.selection.sample_space import SampleSpace, gains
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import targets
from gapbridge.core.estimation.held_out import jackknife
from gapbridge.core.estimation.least_squares import (
    basis_of,
    projected_out,
    solve,
    squared_sigmas,
    unit_columns,
)


def stable_effects(
    selection: Selection, tested: Sequence[int]
) -> tuple[list[int], UnnamedPart, set[int]]:
    """Return the stable ones of ``tested`` candidates, and the unnamed functions fitted with them.

    Third: which of them are kept because the gap is not closed without them.

    Where all links are a cause, the tool point is part of the same geometry and hardly ever
    significant with unnamed functions; it is judged last, by its gain in new regions. The same
    holds for effects without which the gap would not be closed in every part of the log.
    """
    functions = _UnnamedFunctions(selection)
    accused = list(tested)
    tool_point = _tool_point(selection, accused)
    closure = _GapClosure(selection)
    while accused:
        strength = functions.strengths(accused)
        strength[[c in tool_point or c in closure.needed for c in accused]] = np.inf
        if strength.min() >= 1:
            break
        weakest = {int(np.argmin(strength))}
        if len(functions.space.y) > BATCH_REMOVAL_ROWS:
            worst = np.argsort(strength)[: max(1, len(accused) // 8)]
            weakest |= {int(i) for i in worst if strength[i] < BATCH_REMOVAL_STRENGTH}
        if closure.needs_any(accused, [accused[i] for i in sorted(weakest)]):
            continue
        accused = [c for i, c in enumerate(accused) if i not in weakest]
        sized = selection.with_prior_for(accused)
        if sized is not selection:
            selection = sized
            functions = _UnnamedFunctions(selection)
    others = [c for c in accused if c not in tool_point]
    if tool_point and not _tool_point_gains(selection, others, tool_point):
        accused = others
    return accused, functions.fitted_with(accused), closure.needed & set(accused)


def links_predict_new_regions(selection: Selection) -> bool:
    """Return whether the geometry of all links reduces the gap in held-out regions.

    No single parameter is significant, so they are judged together.
    """
    space = selection.space
    named = [c for c in selection.best.chosen if space.candidates[c].named]
    held_out = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    if not held_out.possible:
        return False
    links = [*named, *selection.block]
    return held_out.shrink(links, named).interval[0] > STAND_IN_GAIN


def _tool_point(selection: Selection, chosen: Sequence[int]) -> list[int]:
    """Return the tool point among candidates, where all links are a cause."""
    own = selection.space.candidates
    return [c for c in chosen if selection.block and own[c].effect.estimated_with_links]


def _tool_point_gains(
    selection: Selection, accused: Sequence[int], tool_point: Sequence[int]
) -> bool:
    """Return whether the tool point reduces the gap of held-out regions further than the links."""
    held_out = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    others = [*accused, *selection.block]
    if not held_out.possible:
        return False
    return held_out.shrink([*others, *tool_point], others).interval[0] > STAND_IN_GAIN


class _GapClosure:
    """Whether effects close the gap in every held-out part of a log, and which are needed for it.

    Causes that only together explain the gap (a tool and what bends under it) are not significant
    one by one with unnamed functions. Effects that imitate an unknown one close the gap in some
    parts only. Periodic lines are never needed, because their phase fits any shape, nor is what
    shifts all measured positions alike (the height of the base), which is the mean of any error.
    """

    def __init__(self, selection: Selection) -> None:
        self.needed: set[int] = set()
        self._block, self._candidates = selection.block, selection.space.candidates
        self._part = parts(selection.observation, selection.kept)
        self._held_out = HeldOut(selection, parts=self._part)
        # only of poses: a weight and a gain at one attitude look the same in every part
        self._possible = selection.observation.channel == "position" and self._held_out.possible
        self._shifts = shifts_alike(selection)

    def needs_any(self, accused: Sequence[int], weakest: Iterable[int]) -> bool:
        """Return whether closing the gap needs one of ``weakest``, which is then in ``needed``."""
        self._possible = self.closed(accused)
        for c in weakest if self._possible else ():
            others = [o for o in accused if o != c]
            own = self._candidates[c]
            if not (own.periodic or c in self._shifts or self.closed(others)):
                self.needed.add(c)
                return True
        return False

    def closed(self, accused: Sequence[int]) -> bool:
        """Return whether the effects close the gap in every part of the log."""
        if not self._possible:
            return False
        residual, before = (
            np.bincount(self._part, self._held_out.squares(chosen))
            for chosen in ([*accused, *self._block], self._block)
        )
        worst = float(np.max(residual[before > 0] / before[before > 0], initial=0.0))
        closed = residual.sum() <= CLOSED_SHARE**2 * before.sum()
        return bool(closed and worst <= CLOSED_SHARE_IN_WORST_PART**2)


def shifts_alike(selection: Selection) -> set[int]:
    """Return the candidates whose terms shift all measured positions by the same vector.

    It is the mean of whatever error the positions have.
    """
    alike: set[int] = set()
    if selection.observation.channel != "position":
        return alike
    space, shift = selection.working, targets(selection.observation)["position"]
    constant = basis_of(selection.rows_of(shift))
    for c, term in zip(selection.term_index, selection.terms, strict=True):
        columns = space.columns([c])
        moved = columns @ np.array(term.values[: columns.shape[1]])
        if np.sum((constant.T @ moved) ** 2) > CONTAINED_SHARE * np.sum(moved**2):
            alike.add(c)
    return alike


def closes_gap(selection: Selection, accused: Sequence[int]) -> bool:
    """Return whether candidates close a gap of poses in every part of the log."""
    return _GapClosure(selection).closed(accused)


def links_explain_gap(links: Selection, selection: Selection, accused: Sequence[int]) -> bool:
    """Return whether all links' geometry (``links``) explains what the ``accused`` effects leave.

    In regions that were not fitted it has to reduce the gap, and to leave hardly more than the set
    that the search found, unnamed functions included: these describe what is not geometry better.
    """
    held_out, found = (
        HeldOut(s, parts=parts(s.observation, s.kept)) for s in (links, selection)
    )  # fmt: skip
    if not held_out.possible:
        return False
    candidates = links.space.candidates
    tool_point = [c for c in links.best.chosen if candidates[c].effect.estimated_with_links]
    whole = [*links.block, *tool_point]
    gains = held_out.shrink(whole, accused).interval[0] > LINKS_GAIN
    return gains and held_out.rms(whole) <= LINKS_OVER_SET * found.rms(selection.best.chosen)


class _UnnamedFunctions:
    """The unnamed functions of a selection, chosen again for each set of accused effects."""

    def __init__(self, selection: Selection) -> None:
        self._selection, self.space = selection, selection.working
        unnamed = [
            c
            for c, k in enumerate(self.space.candidates)
            if _models_unknown(k, selection.observation)
        ]
        self._index = np.array(unnamed, dtype=np.int64)
        # tracking by what a joint holds: the form of a droop that is not quite linear
        tracking = selection.observation.channel == "tracking"
        self._forms = {
            c: basis_of(self.space.columns([c])) for c in unnamed
            if tracking and self.space.candidates[c].of_held_torque
        }  # fmt: skip
        size = np.diff(self.space.start)[self._index]
        self._penalty = size * np.log(self.space.freedom) + 2 * np.log(max(len(unnamed), 2))
        self._kept = [c for c in selection.best.chosen if c in set(unnamed)]
        # in the fit of the search, the forms of named effects left out: they contain the effects
        self._first = [c for c in self._kept if c not in self._forms]
        self.current = self._kept  # in the last test
        # a function that moves a joint includes a constant; of a sensor's axis the constant is a
        # bias, whose prior is the size of the function
        self._moved = targets(selection.observation)
        self._constant = {name: selection.rows_of(d) for name, d in self._moved.items()}
        self._is_sensor = selection.observation.joint_columns is None
        self._rows = selection.observation.measured.shape[1]  # of each sample
        self._part = np.repeat(parts(selection.observation, selection.kept), self._rows)

    def strengths(self, accused: list[int]) -> Array:
        """Return the strength of each accused effect; from 1 on it is stable."""
        # of a large log the functions chosen once are kept, and one is added per round
        large = len(self.space.y) > BATCH_REMOVAL_ROWS and len(self._kept) >= MAX_UNNAMED
        chosen = self.current = self.functions_for(accused, 1 if large else MAX_UNNAMED)
        if len(self.space.y) > BATCH_REMOVAL_ROWS:
            self._kept = chosen
        value, spread, identifiable = self._stable_values(
            accused, *self._unnamed_columns(accused, chosen)
        )
        together = [
            unit_columns(self.space.columns(accused)),
            self.space.columns(self._first),
            self._free_constants(accused),
        ]
        # not unit columns: the minimum-norm solution depends on their lengths
        without_unnamed = np.linalg.lstsq(np.hstack(together), self.space.y, rcond=1e-9)[0]
        begin = 0
        sigmas: list[float] = []
        ratio: list[float] = []
        for c in accused:
            size = int(self.space.start[c + 1] - self.space.start[c])
            index = np.arange(begin, begin + size)[identifiable[begin : begin + size]]
            begin += size
            a, b = without_unnamed[index], value[index]
            share = float(a @ b) / max(float(a @ a), 1e-300)
            if not len(index) or share <= 0:
                sigmas.append(0.0)
                ratio.append(0.0)
                continue
            square = squared_sigmas(b, spread[np.ix_(index, index)])
            numbers = float(len(index))
            if not self.space.candidates[c].periodic:  # a line's phase fits any shape
                numbers = 1 + EXTRA_PARAMETER_WEIGHT * (numbers - 1)
            sigmas.append(float(np.sqrt(max(square, 0.0) / numbers)))
            ratio.append(min(share * MAX_VALUE_RATIO, MAX_VALUE_RATIO / share))
        return self._strengths(accused, np.array(sigmas), np.array(ratio))

    def functions_for(self, accused: Sequence[int], most: int = MAX_UNNAMED) -> list[int]:
        """Return the unnamed functions that the residual calls for, penalised for chance alone."""
        space, barred = self.space, self._forms_of_none(accused)
        chosen = [c for c in self._kept if c not in barred]
        for _ in range(most if len(self._index) else 0):
            zero = self._free_constants(accused)
            basis = basis_of(np.hstack([space.columns(accused), self._columns(chosen), zero]))
            residual = projected_out(basis, space.y)
            freedom = max(space.freedom - basis.shape[1], 1.0)
            variance = max(float(residual @ residual) / freedom, space.floor)
            gain = (
                gains(space, residual, basis.T @ space.X)[0][self._index] / variance - self._penalty
            )
            gain[np.isin(self._index, [*chosen, *barred])] = -np.inf
            if gain.max() <= 0:
                break
            chosen.append(int(self._index[np.argmax(gain)]))
        return chosen

    def _forms_of_none(self, accused: Sequence[int]) -> list[int]:
        """Return the functions of what a joint holds, where no droop of that joint is accused."""
        X = unit_columns(self.space.columns(accused))
        return [
            c for c, U in self._forms.items()
            if not (np.einsum("ij,ij->j", U.T @ X, U.T @ X) > CONTAINED_SHARE).any()
        ]  # fmt: skip

    def _free_constants(self, accused: Sequence[int]) -> Array:
        """Return a sensor's constants (m, a) that no accused effect contains: its zero is free.

        A bias that is not accused would otherwise be modelled by functions.
        """
        if not self._is_sensor:
            return np.zeros((len(self.space.y), 0))
        C = np.hstack(list(self._constant.values()))
        V = basis_of(unit_columns(self.space.columns(accused)))
        residual = np.linalg.norm(projected_out(V, C), axis=0) / np.linalg.norm(C, axis=0)
        return np.asarray(C[:, residual > 1e-6])

    def _columns(self, chosen: Sequence[int]) -> Array:
        """Return the columns of unnamed functions, and last the constants of their targets."""
        constants = [self._constant[t] for t in self._targets(chosen)]
        return np.hstack([self.space.columns(chosen), *constants])

    def _targets(self, chosen: Sequence[int]) -> list[str]:
        """Return the targets of the functions of a quantity (mechanical ones have no constant)."""
        functions = [self.space.candidates[c] for c in chosen]
        moved = dict.fromkeys(k.target for k in functions if not k.without_quantity)
        return [t for t in moved if t in self._constant]

    def _constant_sigma(
        self, accused: Sequence[int], chosen: Sequence[int], targets_: Sequence[str]
    ) -> Array:
        """Return the prior 1 sigma of each constant; inf: free.

        Of a sensor's axis it is the size of all unnamed functions of that axis together, relative
        to the scatter of the rows.
        """
        space = self.space
        if not self._is_sensor:
            width = sum(self._constant[t].shape[1] for t in targets_)
            return np.full(width, np.inf)
        columns = self._columns(chosen)
        A = np.hstack([unit_columns(self.space.columns(accused)), columns])
        solution = solve(A, space.y)
        rss = float(np.sum((space.y - A @ solution) ** 2))
        scatter = np.sqrt(max(rss / max(space.freedom - A.shape[1], 1.0), space.floor))
        x = solution[A.shape[1] - columns.shape[1] :]
        begin, made = 0, {t: np.zeros(len(space.y)) for t in targets_}
        for c in chosen:
            own = slice(begin, begin + int(space.start[c + 1] - space.start[c]))
            begin = own.stop
            target = space.candidates[c].target
            if target in made:
                made[target] += space.columns([c]) @ x[own]
        size = [scatter * np.linalg.norm(self._constant[t]) for t in targets_]
        return np.array([np.linalg.norm(made[t]) / n for t, n in zip(targets_, size, strict=True)])

    def _unnamed_columns(
        self, accused: Sequence[int], chosen: Sequence[int]
    ) -> tuple[Array, Array]:
        """Return the unnamed columns beyond the accused effects, and the prior 1 sigma of each."""
        contained = self._contained(accused, chosen)
        functions = _beyond(self.space, accused, chosen, contained)
        targets_ = self._free_targets(chosen, contained)
        constants = [self._constant[t] for t in targets_]
        free = np.full(functions.shape[1], np.inf)
        sigma = np.append(free, self._constant_sigma(accused, chosen, targets_))
        return np.hstack([functions, *constants]), sigma

    def _free_targets(self, chosen: Sequence[int], contained: Mapping[int, Mask]) -> list[str]:
        """Return the targets whose constant is free: a contained form of an effect has its own."""
        own = {self.space.candidates[c].target for c in contained if c in self._forms}
        return [
            t for t in self._targets([c for c in chosen if c not in contained]) if t not in own
        ]  # fmt: skip

    def _contained(self, accused: Sequence[int], chosen: Sequence[int]) -> dict[int, Mask]:
        """Return, by unnamed function, which columns of the accused effects it only contains.

        A pull in any direction contains every weight, and one that points nearly down is a weight.
        A function of a joint's own speed contains its delay, and one that is nearly linear is a
        delay; a function of the torque that a joint holds contains its droop.
        """
        space, X = self.space, unit_columns(self.space.columns(accused))
        contained: dict[int, Mask] = {}
        for c in chosen:
            k = space.candidates[c]
            if not (k.without_quantity or k.of_own_speed or c in self._forms):
                continue
            U = basis_of(space.columns([c]))
            inside = np.einsum("ij,ij->j", U.T @ X, U.T @ X) > CONTAINED_SHARE
            if not inside.any():
                continue
            others = self._columns([o for o in chosen if o != c and o not in contained])
            basis = basis_of(np.hstack([X[:, ~inside], others]))
            own, whole = (basis_of(projected_out(basis, A)) for A in (X[:, inside], U))
            if np.sum((own.T @ space.y) ** 2) > DOMINANT_SHARE * np.sum((whole.T @ space.y) ** 2):
                contained[c] = inside
        return contained

    def _stable_values(
        self, accused: list[int], columns: Array, sigma: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return values of unit columns, their covariance, and which are identifiable.

        The covariance includes the scatter over parts of the log (jackknife): an imitation differs
        among them. Delays are shrunk to the common delay of all joints.
        """
        known = np.isfinite(sigma)
        prior = np.diag(1 / np.maximum(sigma, 1e-300))[known]  # rows added to every part
        X, y = unit_columns(self.space.columns(accused)), self.space.y
        X = np.vstack([X, np.zeros((len(prior), X.shape[1]))])
        y = np.append(y, np.zeros(len(prior)))
        columns = np.vstack([columns, prior])
        part = np.append(self._part, np.full(len(prior), -1))

        def solved(rows: NDArray[np.bool_]) -> tuple[Array, Array, Array, float]:
            A, b, U = X[rows], y[rows], basis_of(columns[rows])
            A, b = projected_out(U, A), projected_out(U, b)
            size, V = np.linalg.eigh(A.T @ A)
            determined = size > DEGENERATE
            inverse = (V * np.where(determined, 1 / np.maximum(size, DEGENERATE), 0)) @ V.T
            x = inverse @ (A.T @ b)
            return x, inverse, (V**2) @ ~determined, float(np.sum((b - A @ x) ** 2))

        value, inverse, in_unnamed, rss = solved(np.ones(len(part), dtype=bool))
        freedom = max(self.space.freedom - X.shape[1] - columns.shape[1], 1.0)
        without = np.array([solved(part != p)[0] for p in np.unique(self._part)])
        spread = inverse * max(rss / freedom, self.space.floor) + jackknife(without)
        identifiable = in_unnamed < MAX_SHARE_IN_UNNAMED
        candidates = [self.space.candidates[c] for c in accused]
        begin = np.cumsum([0, *(len(k.parameters) for k in candidates)])
        late = np.array(
            [b for b, k in zip(begin, candidates, strict=False) if k.effect.is_delay],
            dtype=np.int64,
        )
        length = np.linalg.norm(self.space.columns([c for c, k in zip(
            accused, candidates, strict=True) if k.effect.is_delay]), axis=0)  # fmt: skip
        known = np.where(identifiable[late], np.diag(spread)[late], np.inf)
        x, variance = shrunk_to_common_delay(value[late] / length, known / length**2)
        value[late], identifiable[late] = x * length, np.isfinite(variance)
        spread[late, late] = np.where(identifiable[late], variance * length**2, spread[late, late])
        return value, spread, identifiable

    def fitted_with(self, accused: Sequence[int]) -> UnnamedPart:
        """Return the unnamed functions for the last refit of the accused effects.

        A joint's constant that an accused effect contains is left out: a tool's rotation about the
        last axis would otherwise be as uncertain as its prior.
        """
        chosen, selection = self.current, self._selection
        contained = self._contained(accused, chosen)
        functions = _beyond(selection.space, accused, chosen, contained)
        targets_ = self._free_targets(chosen, contained)
        sigma = self._constant_sigma(accused, chosen, targets_)
        constants = [selection.plain_rows_of(self._moved[t]) for t in targets_]
        C = np.hstack([functions[:, :0], *constants])
        V = basis_of(selection.space.columns(accused))
        size = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
        beyond = np.linalg.norm(projected_out(V, C), axis=0) / size
        free = np.isfinite(sigma) | (beyond**2 > DEGENERATE)
        columns = np.hstack([functions, C[:, free]])
        sigma = np.concatenate([np.full(functions.shape[1], np.inf), sigma[free]])
        region = np.repeat(regions(selection.observation, selection.kept), self._rows)
        return UnnamedPart(columns, sigma, region)

    def _strengths(self, accused: list[int], sigmas: Array, ratio: Array) -> Array:
        """Return strengths; further joints of a stable effect (not of lines) need fewer sigmas."""
        families = [self.space.candidates[c].family for c in accused]
        first = np.minimum(sigmas / MIN_SIGMAS_WITH_UNNAMED, ratio)
        stable = {f for f, s in zip(families, first, strict=True) if s >= 1}
        stable -= {k.family for k in self.space.candidates if k.periodic}
        further = np.array([f in stable for f in families])
        return np.asarray(
            np.where(further, np.minimum(sigmas / MIN_SIGMAS_OF_FURTHER_JOINTS, ratio), first)
        )


def _beyond(
    space: SampleSpace, accused: Sequence[int], chosen: Sequence[int],
    contained: Mapping[int, Mask],
) -> Array:  # fmt: skip
    """Return the columns of unnamed functions, beyond the accused effects that they contain."""
    X, columns = unit_columns(space.columns(accused)), [space.columns([])]
    for c in chosen:
        own = space.columns([c])
        if c in contained:
            own = projected_out(basis_of(X[:, contained[c]]), basis_of(own))
        columns.append(own)
    return np.hstack(columns)


def _models_unknown(candidate: Candidate, observation: Observation) -> bool:
    """Return whether a candidate models an unknown effect, not the form of a named one.

    In position a function of a joint's own approach is backlash; in torque a function of its own
    speed is friction. In tracking a function of its own torque is droop: see ``_forms``.
    """
    if candidate.named:
        return False
    if observation.channel == "tracking":
        return True
    if observation.channel == "torque":
        return not candidate.of_own_speed
    return candidate.target != target_of(candidate.quantity, "approach")
