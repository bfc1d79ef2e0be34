"""Which accusations keep their value beside an unnamed remainder.

A real arm has known effects and something unknown beside them, and what the catalogue holds can
imitate a cause that it does not hold. So every unnamed function that the residual asks for is put
beside the accused effects; an accusation stays that keeps its value beside them, the same in every
region of the log. The weakest goes first, and what it took is then left for the unnamed to take.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.criteria import (
    CLOSED_IN_A_PART,
    CLOSED_SHARE,
    DEGENERATE,
    FURTHER,
    HELD_WHOLLY,
    HOPELESS,
    MAX_DRIFT,
    MAX_TAKEN,
    MAX_UNNAMED,
    MOSTLY,
    SEVERAL_AT_A_TIME,
    SIBLING,
    SIGMAS,
    STAND_IN_GAIN,
)
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.observation import Observation
from gapbridge.core.diagnosis.regions import parts, regions
from gapbridge.core.diagnosis.selection.candidate import Candidate, carrying, joint_target
from gapbridge.core.diagnosis.selection.delay_columns import as_one_delay
from gapbridge.core.diagnosis.selection.problem import gains
from gapbridge.core.diagnosis.selection.refit import Remainder
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.diagnosis.selection.smooth import targets
from gapbridge.core.estimation.held_out import jackknife
from gapbridge.core.estimation.least_squares import basis_of, projected_out, solve, squared_sigmas


def withstanding(
    selection: Selection, believed: Sequence[int]
) -> tuple[list[int], Remainder, set[int]]:
    """Return the candidates, of those believed, that withstand, and the unnamed beside them.

    Third: which of them stay because it takes them to close the gap.

    Where all links are a cause the tool's point is one more number of the same geometry: hardly
    ever sure beside unnamed functions, it is judged by what it does in regions that its fit did not
    see. Until then it stays: without it nothing else would keep its value. So does what it takes to
    close the gap everywhere.
    """
    remainder = _Beside(selection)
    accused = list(believed)
    point = _tool_point(selection, accused)
    closing = _Closing(selection)
    while accused:
        strength = remainder.strengths(accused)
        strength[[c in point or c in closing.needed for c in accused]] = np.inf
        if strength.min() >= 1:
            break
        out = {int(np.argmin(strength))}
        if len(remainder.space.y) > SEVERAL_AT_A_TIME:
            worst = np.argsort(strength)[: max(1, len(accused) // 8)]
            out |= {int(i) for i in worst if strength[i] < HOPELESS}
        if closing.takes(accused, [accused[i] for i in sorted(out)]):
            continue
        accused = [c for i, c in enumerate(accused) if i not in out]
        sized = selection.sized_beside(accused)
        if sized is not selection:
            selection = sized
            remainder = _Beside(selection)
    if point and not _gains(selection, [c for c in accused if c not in point], point):
        accused = [c for c in accused if c not in point]
    return accused, remainder.beside_refit(accused), closing.needed & set(accused)


def links_withstand(selection: Selection) -> bool:
    """Return whether the geometry of all links predicts regions that its fit did not see.

    None of its numbers is sure by itself, so what they do together is judged: it has to gain.
    """
    space = selection.space
    named = [c for c in selection.best.chosen if space.candidates[c].named]
    held = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    if not held.possible:
        return False
    links = [*named, *selection.block]
    return held.shrink(links, named).interval[0] > STAND_IN_GAIN


def _tool_point(selection: Selection, chosen: Sequence[int]) -> list[int]:
    """Return the tool's point among candidates, where all links are a cause."""
    own = selection.space.candidates
    return [c for c in chosen if selection.block and own[c].effect.beside_links]


def _gains(selection: Selection, stays: Sequence[int], point: Sequence[int]) -> bool:
    """Return whether the tool's point shrinks the gap of regions not fitted, beside the links."""
    held = HeldOut(selection, parts=parts(selection.observation, selection.kept))
    rest = [*stays, *selection.block]
    return held.possible and held.shrink([*rest, *point], rest).interval[0] > STAND_IN_GAIN


class _Closing:
    """Whether accusations close the gap in every part of a log, and which of them that takes.

    Each part is predicted by a fit that did not see it. Causes that show only together (a tool and
    what bends under it) leave each other no value that is sure beside unnamed functions; what
    imitates an unknown closes its gap in some parts, not in all. Periodic lines are not asked: a
    line has the phase that suits a shape.
    """

    def __init__(self, selection: Selection) -> None:
        self.needed: set[int] = set()
        self._block, self._candidates = selection.block, selection.space.candidates
        self._part = parts(selection.observation, selection.kept)
        self._held = HeldOut(selection, parts=self._part)
        # of poses: a weight's and a gain's trace in one attitude is the same in every part
        self._possible = selection.observation.channel == "position" and self._held.possible

    def takes(self, accused: Sequence[int], out: Iterable[int]) -> bool:
        """Return whether closing the gap takes one of ``out``, which is then among the needed."""
        self._possible = self.closed(accused)
        for c in out if self._possible else ():
            rest = [o for o in accused if o != c]
            if not (self._candidates[c].periodic or self.closed(rest)):
                self.needed.add(c)
                return True
        return False

    def closed(self, accused: Sequence[int]) -> bool:
        """Return whether accusations close the gap in every part of the log."""
        if not self._possible:
            return False
        left, gap = (
            np.bincount(self._part, self._held.squares(chosen))
            for chosen in ([*accused, *self._block], self._block)
        )
        worst = float(np.max(left[gap > 0] / gap[gap > 0], initial=0.0))
        return left.sum() <= CLOSED_SHARE**2 * gap.sum() and worst <= CLOSED_IN_A_PART**2


def closes_gap(selection: Selection, accused: Sequence[int]) -> bool:
    """Return whether candidates close a gap of poses in every part of the log."""
    return _Closing(selection).closed(accused)


def closes_everywhere(selection: Selection, accused: Sequence[int]) -> bool:
    """Return whether all links' geometry closes, in every part of the log, what the accused leave.

    Each part is predicted by a fit that did not see it. What is no geometry at all reaches that in
    some part by chance, never in all.
    """
    part = parts(selection.observation, selection.kept)
    held = HeldOut(selection, parts=part)
    if not held.possible:
        return False
    count = np.bincount(part)
    candidates = selection.space.candidates
    point = [c for c in selection.best.chosen if candidates[c].effect.beside_links]  # of the tool
    left, gap = (
        np.bincount(part, held.squares(c)) for c in ([*selection.block, *point], accused)
    )  # fmt: skip
    alive = count > 0
    return bool(np.all(left[alive] < CLOSED_SHARE**2 * gap[alive]))


class _Beside:
    """The unnamed functions of a selection, asked for anew as accusations go."""

    def __init__(self, selection: Selection) -> None:
        self._selection, self.space = selection, selection.working
        unnamed = [
            c for c, k in enumerate(self.space.candidates) if _unnamed(k, selection.observation)
        ]
        self._index = np.array(unnamed, dtype=np.int64)
        size = np.diff(self.space.start)[self._index]
        self._price = size * np.log(self.space.freedom) + 2 * np.log(max(len(unnamed), 2))
        self._asked = [c for c in selection.best.chosen if c in set(unnamed)]
        self._first = self._asked  # beside which the accused were found
        self.beside = self._asked  # those of the last question
        # a constant is part of any function that moves a joint; of a sensor's axis it is a bias,
        # and no more of it is the function's than the function is large
        self._moved = targets(selection.observation)
        self._constant = {name: selection.rows_of(d) for name, d in self._moved.items()}
        self._sensed = selection.observation.joint_columns is None
        self._rows = selection.observation.measured.shape[1]  # of each sample
        self._part = np.repeat(parts(selection.observation, selection.kept), self._rows)

    def strengths(self, accused: list[int]) -> Array:
        """Return of each accusation how far it is over what it takes to stay (1: just)."""
        # of a large log the functions asked for once stay, so that one more is asked for a round
        large = len(self.space.y) > SEVERAL_AT_A_TIME and len(self._asked) >= MAX_UNNAMED
        asked = self.beside = self.asked_for(accused, 1 if large else MAX_UNNAMED)
        if len(self.space.y) > SEVERAL_AT_A_TIME:
            self._asked = asked
        value, spread, shown = self._values(accused, *self._beyond(accused, asked))
        together = [self._unit(accused), self.space.columns(self._first), self._zero(accused)]
        # what the rows leave open goes by these columns' own lengths: not to unit ones
        alone = np.linalg.lstsq(np.hstack(together), self.space.y, rcond=1e-9)[0]
        begin = 0
        sigmas: list[float] = []
        steady: list[float] = []
        for c in accused:
            size = int(self.space.start[c + 1] - self.space.start[c])
            index = np.arange(begin, begin + size)[shown[begin : begin + size]]
            begin += size
            a, b = alone[index], value[index]
            share = float(a @ b) / max(float(a @ a), 1e-300)
            if not len(index) or share <= 0:
                sigmas.append(0.0)
                steady.append(0.0)
                continue
            square = squared_sigmas(b, spread[np.ix_(index, index)])
            numbers = float(len(index))
            if not self.space.candidates[c].periodic:  # a line has the phase that suits a shape
                numbers = 1 + FURTHER * (numbers - 1)
            sigmas.append(float(np.sqrt(max(square, 0.0) / numbers)))
            steady.append(min(share * MAX_DRIFT, MAX_DRIFT / share))
        return self._with_siblings(accused, np.array(sigmas), np.array(steady))

    def asked_for(self, accused: Sequence[int], most: int = MAX_UNNAMED) -> list[int]:
        """Return the unnamed functions that the residual asks for, penalised for chance alone."""
        space, asked = self.space, list(self._asked)
        for _ in range(most if len(self._index) else 0):
            zero = self._zero(accused)
            basis = basis_of(np.hstack([space.columns(accused), self._beside(asked), zero]))
            left = projected_out(basis, space.y)
            freedom = max(space.freedom - basis.shape[1], 1.0)
            variance = max(float(left @ left) / freedom, space.floor)
            gain = gains(space, left, basis.T @ space.X)[0][self._index] / variance - self._price
            gain[np.isin(self._index, asked)] = -np.inf
            if gain.max() <= 0:
                break
            asked.append(int(self._index[np.argmax(gain)]))
        return asked

    def _zero(self, accused: Sequence[int]) -> Array:
        """Return a sensor's constants (m, a) that no accused effect holds: its zero is not sure.

        A constant that is not accused, but there, would be asked for as functions.
        """
        if not self._sensed:
            return np.zeros((len(self.space.y), 0))
        C = np.hstack(list(self._constant.values()))
        V = basis_of(self._unit(accused))
        left = np.linalg.norm(projected_out(V, C), axis=0) / np.linalg.norm(C, axis=0)
        return np.asarray(C[:, left > 1e-6])

    def _beside(self, asked: Sequence[int]) -> Array:
        """Return the unnamed columns, and last the constants of what they move."""
        constants = [self._constant[t] for t in self._targets(asked)]
        return np.hstack([self.space.columns(asked), *constants])

    def _targets(self, asked: Sequence[int]) -> list[str]:
        """Return what the functions of a quantity move: a joint that bends moves no angle."""
        functions = [self.space.candidates[c] for c in asked]
        moved = dict.fromkeys(k.target for k in functions if not k.of_no_quantity)
        return [t for t in moved if t in self._constant]

    def _sigma(self, accused: Sequence[int], asked: Sequence[int]) -> Array:
        """Return the prior 1 sigma of each constant; inf where it is wholly the function's.

        Of a sensor's axis it is as large as all unnamed functions of that axis together; in units
        in which the rows scatter by one.
        """
        targets_, space = self._targets(asked), self.space
        if not self._sensed:
            width = sum(self._constant[t].shape[1] for t in targets_)
            return np.full(width, np.inf)
        beside = self._beside(asked)
        A = np.hstack([self._unit(accused), beside])
        solution = solve(A, space.y)
        rss = float(np.sum((space.y - A @ solution) ** 2))
        scatter = np.sqrt(max(rss / max(space.freedom - A.shape[1], 1.0), space.floor))
        x = solution[A.shape[1] - beside.shape[1] :]
        begin, made = 0, {t: np.zeros(len(space.y)) for t in targets_}
        for c in asked:
            own = slice(begin, begin + int(space.start[c + 1] - space.start[c]))
            begin = own.stop
            target = space.candidates[c].target
            if target in made:
                made[target] += space.columns([c]) @ x[own]
        size = [scatter * np.linalg.norm(self._constant[t]) for t in targets_]
        return np.array([np.linalg.norm(made[t]) / n for t, n in zip(targets_, size, strict=True)])

    def _beyond(self, accused: Sequence[int], asked: Sequence[int]) -> tuple[Array, Array]:
        """Return the unnamed columns, of those that hold an accused effect what they do beyond it.

        With the prior 1 sigma of each. A pull in any direction holds every weight; one that points
        nearly down is a weight. A function of a joint's own speed holds its delay; one that is
        nearly straight is a delay.
        """
        space, X, beside = self.space, self._unit(accused), self._beside(asked)
        constants = self._sigma(accused, asked)
        for c in asked:
            if not (space.candidates[c].of_no_quantity or _of_own_speed(space.candidates[c])):
                continue
            U = basis_of(space.columns([c]))
            inside = np.einsum("ij,ij->j", U.T @ X, U.T @ X) > HELD_WHOLLY
            if not inside.any():
                continue
            others = self._beside([o for o in asked if o != c])
            rest = basis_of(np.hstack([X[:, ~inside], others]))
            own, whole = (basis_of(projected_out(rest, A)) for A in (X[:, inside], U))
            if np.sum((own.T @ space.y) ** 2) < MOSTLY * np.sum((whole.T @ space.y) ** 2):
                continue
            V = basis_of(X[:, inside])
            beside = np.hstack([projected_out(V, U), others])
        free = np.full(beside.shape[1] - len(constants), np.inf)
        return beside, np.concatenate([free, constants])

    def _unit(self, accused: Sequence[int]) -> Array:
        X = self.space.columns(accused)
        return np.asarray(X / (np.sqrt(np.einsum("ij,ij->j", X, X)) + 1e-300))

    def _values(
        self, accused: list[int], beside: Array, sigma: Array
    ) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Return values of unit columns, their covariance with scatter, and which are shown.

        The scatter is a jackknife over parts of the log: what only imitates differs among them.
        Of delays each joint's stands beside the others'.
        """
        known = np.isfinite(sigma)
        prior = np.diag(1 / np.maximum(sigma, 1e-300))[known]  # rows that every part holds
        X, y = self._unit(accused), self.space.y
        X, y = (
            np.vstack([X, np.zeros((len(prior), X.shape[1]))]),
            np.append(y, np.zeros(len(prior))),
        )
        beside = np.vstack([beside, prior])
        part = np.append(self._part, np.full(len(prior), -1))

        def solved(rows: NDArray[np.bool_]) -> tuple[Array, Array, Array, float]:
            A, b, U = X[rows], y[rows], basis_of(beside[rows])
            A, b = projected_out(U, A), projected_out(U, b)
            size, V = np.linalg.eigh(A.T @ A)
            open_ = size > DEGENERATE
            inverse = (V * np.where(open_, 1 / np.maximum(size, DEGENERATE), 0)) @ V.T
            x = inverse @ (A.T @ b)
            return x, inverse, (V**2) @ ~open_, float(np.sum((b - A @ x) ** 2))

        value, inverse, taken, rss = solved(np.ones(len(part), dtype=bool))
        freedom = max(self.space.freedom - X.shape[1] - beside.shape[1], 1.0)
        without = np.array([solved(part != p)[0] for p in np.unique(self._part)])
        spread = inverse * max(rss / freedom, self.space.floor) + jackknife(without)
        shown = taken < MAX_TAKEN
        candidates = [self.space.candidates[c] for c in accused]
        begin = np.cumsum([0, *(len(k.parameters) for k in candidates)])
        late = np.array(
            [b for b, k in zip(begin, candidates, strict=False) if k.effect.delays], dtype=np.int64
        )
        length = np.linalg.norm(self.space.columns([c for c, k in zip(
            accused, candidates, strict=True) if k.effect.delays]), axis=0)  # fmt: skip
        known = np.where(shown[late], np.diag(spread)[late], np.inf)
        x, variance = as_one_delay(value[late] / length, known / length**2)
        value[late], shown[late] = x * length, np.isfinite(variance)
        spread[late, late] = np.where(shown[late], variance * length**2, spread[late, late])
        return value, spread, shown

    def beside_refit(self, accused: Sequence[int]) -> Remainder:
        """Return what stands beside the accused in their last refit.

        A joint's constant that an accused effect holds is the effect's: a tool's turn about the
        last axis would else be as unsure as its prior.
        """
        asked, selection = self.beside, self._selection
        functions, sigma = selection.space.columns(asked), self._sigma(accused, asked)
        constants = [selection.plain_rows_of(self._moved[t]) for t in self._targets(asked)]
        C = np.hstack([functions[:, :0], *constants])
        V = basis_of(selection.space.columns(accused))
        size = np.maximum(np.linalg.norm(C, axis=0), 1e-300)
        beyond = np.linalg.norm(projected_out(V, C), axis=0) / size
        free = np.isfinite(sigma) | (beyond**2 > DEGENERATE)
        columns = np.hstack([functions, C[:, free]])
        sigma = np.concatenate([np.full(functions.shape[1], np.inf), sigma[free]])
        region = np.repeat(regions(selection.observation, selection.kept), self._rows)
        return Remainder(columns, sigma, region)

    def _with_siblings(self, accused: list[int], sigmas: Array, steady: Array) -> Array:
        """Return strengths: less is asked at further joints of an effect; of lines as much."""
        families = [self.space.candidates[c].family for c in accused]
        first = np.minimum(sigmas / SIGMAS, steady)
        stays = {f for f, s in zip(families, first, strict=True) if s >= 1}
        stays -= {k.family for k in self.space.candidates if k.periodic}
        sibling = np.array([f in stays for f in families])
        return np.asarray(np.where(sibling, np.minimum(sigmas / SIBLING, steady), first))


def _unnamed(candidate: Candidate, observation: Observation) -> bool:
    """Return whether a candidate stands for an unknown, and not for a named effect's own form.

    A function of a joint's own last motion that moves it is play. Of joints that are measured one
    by one, a function of a joint's own speed is friction, and of its own torque droop; what moves
    it by its own speed may be more than a delay.
    """
    if candidate.named:
        return False
    if observation.channel == "tracking":
        return candidate.target != carrying(candidate.quantity)
    if observation.channel == "torque":
        return not _of_own_speed(candidate)
    stem, _, index = candidate.quantity.rpartition("_")
    return stem != "approach" or candidate.target != joint_target(int(index) + 1)


def _of_own_speed(candidate: Candidate) -> bool:
    """Return whether a candidate moves a joint by a function of its own speed."""
    stem, _, index = candidate.quantity.rpartition("_")
    own = index.isdigit() and candidate.target == joint_target(int(index) + 1)
    return own and stem in ("actual_qd", "target_qd")
