"""What a fleet's diagnoses say together: what recurs, what drifts, what stands out."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gapbridge.bridge.fleet.drift import (
    ChannelFigure,
    Drift,
    Figure,
    Outlier,
    Quantity,
    Series,
    drifts,
    far_from_median,
    places,
)
from gapbridge.bridge.fleet.task import Outcome, by_arm, usable
from gapbridge.core.diagnosis.channel_diagnosis import Verdict

GAP = "gap_rms"


@dataclass(frozen=True)
class Recurrence:
    """An effect over the fleet."""

    channel: str
    effect: str
    sessions: int  # where it is accused
    looked: int  # sessions whose log could show it
    arms: int  # with at least one such session
    arms_looked: int
    always: int  # arms where every session that could show it accuses it
    joints: tuple[tuple[int, int], ...]  # joint, sessions; most first
    shrink: float  # median of what it takes off the gap, held out
    tied: int  # sessions where the data cannot distinguish it from another


@dataclass(frozen=True)
class Onset:
    """An effect that an arm has from some session on."""

    arm: str
    channel: str
    effect: str
    since: str  # session
    before: int  # sessions without
    after: int  # sessions with


@dataclass(frozen=True)
class Diagnosed:
    """The fleet."""

    recurrences: tuple[Recurrence, ...]
    drifts: tuple[Drift, ...]
    onsets: tuple[Onset, ...]
    outliers: tuple[Outlier, ...]
    verdicts: tuple[tuple[Verdict, int], ...]  # verdict, sessions


def diagnosed(outcomes: Sequence[Outcome]) -> Diagnosed:
    """Return what the diagnoses of all sessions say together."""
    arms = by_arm(outcomes)
    done = usable(outcomes)
    return Diagnosed(
        tuple(_recurrences(done)), tuple(drifts(list(_series(arms)))), tuple(_onsets(arms)),
        tuple(_outliers(done)),
        tuple(Counter(Verdict(o.result["verdict"]) for o in done).most_common()),
    )  # fmt: skip


def _accused(outcome: Outcome) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    """Return the rows of each accused effect of a session."""
    found: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in outcome.result["rows"]:
        if row["accused"]:
            found[row["channel"], row["effect"]].append(row)
    return found


def _looked(outcome: Outcome) -> set[tuple[str, str]]:
    return {(row["channel"], row["effect"]) for row in outcome.result["rows"]}


def _recurrences(done: Sequence[Outcome]) -> list[Recurrence]:
    accused: dict[tuple[str, str], list[tuple[str, list[Mapping[str, Any]]]]] = defaultdict(list)
    looked: dict[tuple[str, str], list[str]] = defaultdict(list)
    for outcome in done:
        for key, rows in _accused(outcome).items():
            accused[key].append((outcome.arm, rows))
        for key in _looked(outcome):
            looked[key].append(outcome.arm)
    found = [_recurrence(key, accused[key], looked[key]) for key in accused]
    return sorted(found, key=lambda r: (-r.sessions, r.channel, r.effect))


def _recurrence(
    key: tuple[str, str], accused: list[tuple[str, list[Mapping[str, Any]]]], looked: list[str]
) -> Recurrence:
    joints = Counter(j for _, rows in accused for j in {j for row in rows for j in row["joints"]})
    shrinks = [rows[0]["shrink"] for _, rows in accused if rows[0]["shrink"] is not None]
    having, seeing = Counter(arm for arm, _ in accused), Counter(looked)
    return Recurrence(
        *key, len(accused), len(looked), len(having), len(seeing),
        sum(having[arm] == seeing[arm] for arm in having), tuple(joints.most_common()),
        float(np.median(shrinks)) if shrinks else float("nan"),
        sum(bool(rows[0]["indistinguishable_from"]) for _, rows in accused),
    )  # fmt: skip


def _series(arms: Mapping[str, Sequence[Outcome]]) -> Iterator[Series]:
    for arm, sessions in arms.items():
        at, per = places([o.result["time"] for o in sessions])
        values: dict[tuple[str, str, str], list[tuple[int, float, float]]] = defaultdict(list)
        for i, outcome in enumerate(sessions):
            for row in outcome.result["rows"]:
                if row["accused"] and row["std"]:
                    key = (row["channel"], row["parameter"], row["unit"])
                    values[key].append((i, row["value"], row["std"]))
            for channel in outcome.result["channels"]:
                # how large the gap is scatters by a share of itself; the share is the fleet's
                if channel[GAP]:
                    key = (channel["channel"], GAP, channel["unit"])
                    values[key].append((i, channel[GAP], 0.02 * channel[GAP]))
        kind = sessions[0].result["type"]
        for (channel, name, unit), found in values.items():
            index = [i for i, _, _ in found]
            quantity: Quantity = ChannelFigure(channel, Figure.GAP) if name == GAP else name
            yield Series(
                arm, quantity, unit, f"{kind} {channel} {name}", at[index], per,
                np.array([v for _, v, _ in found]), np.array([s for _, _, s in found]),
                tuple(sessions[i].session for i in index),
            )  # fmt: skip


def _onsets(arms: Mapping[str, Sequence[Outcome]]) -> Iterator[Onset]:
    for arm, sessions in arms.items():
        accused = [set(_accused(o)) for o in sessions]
        looked = [_looked(o) for o in sessions]
        for key in sorted(set().union(*accused)):
            seen = [i for i in range(len(sessions)) if key in looked[i]]
            having = [key in accused[i] for i in seen]
            before = having.index(True)
            after = len(having) - before
            if before >= 2 and after >= 2 and all(having[before:]):
                yield Onset(arm, *key, sessions[seen[before]].session, before, after)


def _outliers(done: Sequence[Outcome]) -> list[Outlier]:
    found: list[Outlier] = []
    figures = ((GAP, Figure.GAP), ("remaining_rms", Figure.UNEXPLAINED))
    kinds = {(o.result["type"], c["channel"]) for o in done for c in o.result["channels"]}
    for kind, name in sorted(kinds):
        same = [
            (o, c) for o in done if o.result["type"] == kind
            for c in o.result["channels"] if c["channel"] == name
        ]  # fmt: skip
        for key, figure in figures:
            for i, usual, deviations in far_from_median([c[key] for _, c in same], ratios=True):
                outcome, channel = same[i]
                found.append(Outlier(
                    outcome.arm, outcome.session, ChannelFigure(name, figure), channel[key], usual,
                    channel["unit"], deviations,
                ))  # fmt: skip
    found += _parameter_outliers(done)
    return sorted(found, key=lambda o: -abs(o.deviations))


def _parameter_outliers(done: Sequence[Outcome]) -> Iterator[Outlier]:
    values: dict[tuple[str, str, str], list[tuple[Outcome, float]]] = defaultdict(list)
    for outcome in done:
        for row in outcome.result["rows"]:
            if row["accused"]:
                key = (outcome.result["type"], row["parameter"], row["unit"])
                values[key].append((outcome, row["value"]))
    for (_, name, unit), found in values.items():
        for i, usual, deviations in far_from_median([v for _, v in found], ratios=False):
            outcome, value = found[i]
            yield Outlier(outcome.arm, outcome.session, name, value, usual, unit, deviations)
