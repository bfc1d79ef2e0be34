"""Summary of the diagnoses of a fleet: recurring effects, drifts, onsets and outliers."""

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
    median_outliers,
    session_times,
    significant_drifts,
)
from gapbridge.bridge.fleet.task import Outcome, by_arm, usable
from gapbridge.core.diagnosis.channel_diagnosis import Verdict
from gapbridge.core.effects import CATALOGUE

GAP = "gap_rms"


@dataclass(frozen=True)
class Recurrence:
    """How often an effect is named over the fleet."""

    channel: str
    effect: str
    sessions: int  # that name it as a cause
    observable: int  # sessions whose log could show it
    arms: int  # with at least one such session
    arms_observable: int
    always: int  # arms of which every session that could show it names it
    joints: tuple[tuple[int, int], ...]  # (joint, sessions), most sessions first
    shrink: float  # median share of the held-out gap that it removes
    tied: int  # sessions whose data cannot distinguish it from another effect


@dataclass(frozen=True)
class Onset:
    """An effect that all sessions of an arm have from one session on, and none before."""

    arm: str
    channel: str
    effect: str
    since: str  # name of the session
    before: int  # sessions without
    after: int  # sessions with


@dataclass(frozen=True)
class FleetDiagnosis:
    """The summary of a fleet."""

    recurrences: tuple[Recurrence, ...]
    drifts: tuple[Drift, ...]
    onsets: tuple[Onset, ...]
    outliers: tuple[Outlier, ...]
    verdicts: tuple[tuple[Verdict, int], ...]  # verdict, sessions


def summarise(outcomes: Sequence[Outcome]) -> FleetDiagnosis:
    """Return the summary of the diagnoses of all usable sessions."""
    arms = by_arm(outcomes)
    done = usable(outcomes)
    return FleetDiagnosis(
        tuple(_recurrences(done)), tuple(significant_drifts(list(_series(arms)))),
        tuple(_onsets(arms)),
        tuple(_outliers(done)),
        tuple(Counter(Verdict(o.result["verdict"]) for o in done).most_common()),
    )  # fmt: skip


def _causes(outcome: Outcome) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    """Return the rows of each cause of a session, by (channel, effect)."""
    causes: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in outcome.result["rows"]:
        if row["accused"]:
            causes[row["channel"], row["effect"]].append(row)
    return causes


def _observable(outcome: Outcome) -> set[tuple[str, str]]:
    return {(row["channel"], row["effect"]) for row in outcome.result["rows"]}


def _recurrences(done: Sequence[Outcome]) -> list[Recurrence]:
    causes: dict[tuple[str, str], list[tuple[str, list[Mapping[str, Any]]]]] = defaultdict(list)
    observable: dict[tuple[str, str], list[str]] = defaultdict(list)
    for outcome in done:
        for key, rows in _causes(outcome).items():
            causes[key].append((outcome.arm, rows))
        for key in _observable(outcome):
            observable[key].append(outcome.arm)
    recurrences = [_recurrence(key, causes[key], observable[key]) for key in causes]
    return sorted(recurrences, key=lambda r: (-r.sessions, r.channel, r.effect))


def _recurrence(
    key: tuple[str, str], causes: list[tuple[str, list[Mapping[str, Any]]]], observable: list[str]
) -> Recurrence:
    joints = Counter(j for _, rows in causes for j in {j for row in rows for j in row["joints"]})
    shrinks = [rows[0]["shrink"] for _, rows in causes if rows[0]["shrink"] is not None]
    named, total = Counter(arm for arm, _ in causes), Counter(observable)
    return Recurrence(
        *key, len(causes), len(observable), len(named), len(total),
        sum(named[arm] == total[arm] for arm in named), tuple(joints.most_common()),
        float(np.median(shrinks)) if shrinks else float("nan"),
        sum(bool(rows[0]["indistinguishable_from"]) for _, rows in causes),
    )  # fmt: skip


def _is_moment(row: Mapping[str, Any]) -> bool:
    """Return whether a row is a step's time, which is another one in each session."""
    return CATALOGUE[row["effect"]].at_moment and row["unit"] == "s"


def _series(arms: Mapping[str, Sequence[Outcome]]) -> Iterator[Series]:
    for arm, sessions in arms.items():
        times, per = session_times([o.result["time"] for o in sessions])
        values: dict[tuple[str, str, str], list[tuple[int, float, float]]] = defaultdict(list)
        for i, outcome in enumerate(sessions):
            for row in outcome.result["rows"]:
                if row["accused"] and row["std"] and not _is_moment(row):
                    key = (row["channel"], row["parameter"], row["unit"])
                    values[key].append((i, row["value"], row["std"]))
            for channel in outcome.result["channels"]:
                # its scatter is proportional to the gap; the factor is estimated per group
                if channel[GAP]:
                    key = (channel["channel"], GAP, channel["unit"])
                    values[key].append((i, channel[GAP], 0.02 * channel[GAP]))
        kind = sessions[0].result["type"]
        for (channel, name, unit), found in values.items():
            index = [i for i, _, _ in found]
            quantity: Quantity = ChannelFigure(channel, Figure.GAP) if name == GAP else name
            yield Series(
                arm, quantity, unit, f"{kind} {channel} {name}", times[index], per,
                np.array([v for _, v, _ in found]), np.array([s for _, _, s in found]),
                tuple(sessions[i].session for i in index),
            )  # fmt: skip


def _onsets(arms: Mapping[str, Sequence[Outcome]]) -> Iterator[Onset]:
    for arm, sessions in arms.items():
        causes = [set(_causes(o)) for o in sessions]
        observable = [_observable(o) for o in sessions]
        for key in sorted(set().union(*causes)):
            visible = [i for i in range(len(sessions)) if key in observable[i]]
            named = [key in causes[i] for i in visible]
            before = named.index(True)
            after = len(named) - before
            if before >= 2 and after >= 2 and all(named[before:]):
                yield Onset(arm, *key, sessions[visible[before]].session, before, after)


def _outliers(done: Sequence[Outcome]) -> list[Outlier]:
    outliers: list[Outlier] = []
    figures = ((GAP, Figure.GAP), ("remaining_rms", Figure.UNEXPLAINED))
    kinds = {(o.result["type"], c["channel"]) for o in done for c in o.result["channels"]}
    for kind, name in sorted(kinds):
        same = [
            (o, c) for o in done if o.result["type"] == kind
            for c in o.result["channels"] if c["channel"] == name
        ]  # fmt: skip
        for key, figure in figures:
            for i, median, deviations in median_outliers([c[key] for _, c in same], ratios=True):
                outcome, channel = same[i]
                outliers.append(Outlier(
                    outcome.arm, outcome.session, ChannelFigure(name, figure), channel[key], median,
                    channel["unit"], deviations,
                ))  # fmt: skip
    outliers += _parameter_outliers(done)
    return sorted(outliers, key=lambda o: -abs(o.deviations))


def _parameter_outliers(done: Sequence[Outcome]) -> Iterator[Outlier]:
    rows: dict[tuple[str, str, str], list[tuple[Outcome, Mapping[str, Any]]]] = defaultdict(list)
    for outcome in done:
        for row in outcome.result["rows"]:
            if row["accused"] and not _is_moment(row):
                key = (outcome.result["type"], row["parameter"], row["unit"])
                rows[key].append((outcome, row))
    for (_, name, unit), found in rows.items():
        values, stds = [row["value"] for _, row in found], [row["std"] for _, row in found]
        for i, median, deviations in median_outliers(values, ratios=False, stds=stds):
            outcome = found[i][0]
            yield Outlier(outcome.arm, outcome.session, name, values[i], median, unit, deviations)
