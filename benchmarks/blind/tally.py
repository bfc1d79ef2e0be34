"""Adds scores up: the confusion matrix, and the figures that must be reached."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.blind.score import NOWHERE, CaseScore

NONE = "none"


@dataclass(frozen=True)
class Criterion:
    """One figure against what it must reach; value None where there were no cases."""

    name: str
    value: float | None
    target: float
    at_least: bool
    cases: int
    form: str = "share"  # share | ratio | seconds

    @property
    def reached(self) -> bool | None:
        """Return whether it is reached; None where nothing was measured."""
        if self.value is None:
            return None
        return self.value >= self.target if self.at_least else self.value <= self.target

    def shown(self, value: float | None) -> str:
        """Return a value in its own form."""
        if value is None:
            return "–"
        return {"share": f"{100 * value:.1f} %", "ratio": f"{value:.3f}"}.get(
            self.form, f"{value:.2f} s"
        )


def _share(flags: Iterable[bool]) -> tuple[float | None, int]:
    flags = list(flags)
    return (float(np.mean(flags)) if flags else None), len(flags)


def _of(scores: Sequence[CaseScore], *groups: str) -> list[CaseScore]:
    return [s for s in scores if s.group in groups]


def criteria(scores: Sequence[CaseScore]) -> list[Criterion]:
    """Return the figures of the benchmark against their targets."""
    known, several = _of(scores, "known"), _of(scores, "several")
    outside, withheld = _of(scores, "outside"), _of(scores, "withheld")
    unknown, hard = [*outside, *withheld], _of(scores, "hard")
    out = [
        _criterion("one effect: identified, or its equivalent with the tie reported", 0.98, known),
        Criterion("its joints right", *_at(0.96, _share(
            s.joints_right for s in known if s.ok and s.joints_right is not None))),
        _criterion("two or three effects: all of them, no others", 0.93, several),
        _criterion("clean data: no cause, no structure", 0.995, _of(scores, "clean")),
        _criterion("outside the catalogue: unexplained, no cause named", 0.93, outside),
        Criterion("withheld: unexplained, equivalent, or first order with residual structure",
                  *_at(0.95, _share(s.ok or s.outcome == "first_order" for s in withheld))),
        _criterion("withheld: no cause named except an equivalent effect", 0.95, withheld),
        Criterion("the quantity it depends on is among the first three", *_at(0.85, _share(
            s.depends_right for s in unknown if s.depends_right is not None))),
        _criterion("hard data: identified, or a tie reported", 0.90, hard),
        Criterion("hard data: false causes", *_at(0.01, _share(
            bool(s.false) for s in hard), at_least=False)),
    ]  # fmt: skip
    many, mixed = _of(scores, "many"), _of(scores, "mixed")
    out += [
        _criterion("four and more at once: all of them, no others", 0.90, many),
        _criterion("random arms", 0.95, _of(scores, "arm")),
        _criterion("two sessions, a frame each", 0.95, _of(scores, "sessions")),
        _criterion("clustered poses, heavy-tailed noise, duplicated rows", 0.95,
                   _of(scores, "laid_out")),
        Criterion("beside an unknown effect: known ones identified", *_at(0.90, _share(
            k < s.known_named for s in mixed for k in range(s.known)))),
        Criterion("beside an unknown effect: residual structure reported", *_at(0.95, _share(
            s.admitted for s in mixed))),
        Criterion("beside an unknown effect: cases with a false cause", *_at(0.01, _share(
            bool(s.false) for s in mixed), at_least=False)),
    ]  # fmt: skip
    shown = [
        s.reported_beyond / s.true_beyond for s in scores if s.reported_beyond and s.true_beyond
    ]
    for at_least, target in ((True, 0.8), (False, 1.25)):
        word = "at least" if at_least else "at most"
        out.append(Criterion(f"reported error in a new region over the true one, {word}",
                             float(np.median(shown)) if shown else None, target, at_least,
                             len(shown), "ratio"))  # fmt: skip
    remainders = [s.remainder for s in scores if s.remainder is not None]
    out.append(_median("held-out error over the noise floor, median", 1.10, remainders, "ratio"))
    z = z_scores(scores)
    out.append(Criterion("parameters with |z| < 3", *_at(0.97, _share(abs(x) < 3 for x in z))))
    slips = [z for s in scores for n, z in s.z.items() if "_slip" in n]
    out.append(
        Criterion("slips: sizes with |z| < 3", *_at(0.97, _share(abs(z) < 3 for z in slips)))
    )
    out.append(
        Criterion(
            "slips: moment within one row",
            *_at(0.97, _share(right for s in scores for right in s.moments)),
        )
    )
    for at_least, target in ((True, 0.93), (False, 0.97)):
        word = "at least" if at_least else "at most"
        out.append(Criterion(f"95 % intervals that contain the true value, {word}",
                             *_at(target, _share(abs(x) < 1.96 for x in z), at_least)))  # fmt: skip
    static = [s.seconds for s in scores if s.channel in ("position", "wrench") and s.seconds]
    moving = [s.seconds for s in scores if s.channel in ("tracking", "torque") and s.seconds]
    out.append(_median("static case, median time", 2.0, static, "seconds"))
    longest = max(moving) if moving else None
    out.append(Criterion("dynamic log, longest time", longest, 10.0, False, len(moving), "seconds"))
    return out


def _criterion(name: str, target: float, scores: Sequence[CaseScore]) -> Criterion:
    return Criterion(name, *_at(target, _share(s.ok for s in scores)))


def _at(
    target: float, share: tuple[float | None, int], at_least: bool = True
) -> tuple[float | None, float, bool, int]:
    return share[0], target, at_least, share[1]


def _median(name: str, target: float, values: Sequence[float], form: str) -> Criterion:
    value = float(np.median(values)) if values else None
    return Criterion(name, value, target, False, len(values), form)


def z_scores(scores: Sequence[CaseScore]) -> list[float]:
    """Return the z-scores of all parameters of exactly right diagnoses."""
    return [z for s in scores for z in s.z.values()]


def row_of(score: CaseScore) -> str:
    """Return the matrix row of a case."""
    if score.group == "outside":
        return f"{NOWHERE}: {score.put_in[0]}"
    return score.kind


def matrix(scores: Sequence[CaseScore]) -> tuple[list[str], list[str], dict[str, dict[str, float]]]:
    """Return rows (put in), columns (named) and the cells; a case with k names gives 1/k to each.

    Nothing named is ``none`` where no structure was left, else ``not in the catalogue``.
    """
    cells: dict[str, dict[str, float]] = defaultdict(lambda: defaultdict(float))
    for s in scores:
        row = cells[row_of(s)]
        if s.outcome == "failed":
            row["failed"] += 1
        elif s.named:
            for name in s.named:
                row[name] += 1 / len(s.named)
        else:
            row[NOWHERE if s.admitted else NONE] += 1
    named = {c for row in cells.values() for c in row} - {NONE, NOWHERE, "failed"}
    columns = [*sorted(named), NONE, NOWHERE]
    if any("failed" in row for row in cells.values()):
        columns.append("failed")
    return list(cells), columns, {r: dict(c) for r, c in cells.items()}


@dataclass(frozen=True)
class KindTally:
    """One kind of case added up."""

    kind: str
    group: str
    cases: int
    right: int
    tied: int
    joints: float | None
    false: int
    admitted: int
    depends: float | None
    remainder: float | None
    z_far: float | None  # share of |z| >= 3
    seconds: float | None
    outcomes: dict[str, int]
    needless: int


def by_kind(scores: Sequence[CaseScore]) -> list[KindTally]:
    """Return the scores added up by kind, in the order they first came."""
    out = []
    for kind in dict.fromkeys(s.kind for s in scores):
        own = [s for s in scores if s.kind == kind]
        outcomes: dict[str, int] = defaultdict(int)
        for s in own:
            outcomes[s.outcome] += 1
        remainders = [s.remainder for s in own if s.remainder is not None]
        times = [s.seconds for s in own if s.seconds is not None]
        out.append(
            KindTally(
                kind=kind,
                group=own[0].group,
                cases=len(own),
                right=outcomes["right"],
                tied=outcomes["right_tie"],
                joints=_share(s.joints_right for s in own if s.joints_right is not None)[0],
                false=sum(bool(s.false) for s in own),
                admitted=sum(s.admitted for s in own),
                depends=_share(s.depends_right for s in own if s.depends_right is not None)[0],
                remainder=float(np.median(remainders)) if remainders else None,
                z_far=_share(abs(z) >= 3 for s in own for z in s.z.values())[0],
                seconds=float(np.median(times)) if times else None,
                outcomes={k: v for k, v in outcomes.items() if v},
                needless=sum(bool(s.needless_ties) for s in own),
            )
        )
    return out
