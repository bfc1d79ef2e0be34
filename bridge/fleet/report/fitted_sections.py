"""Sections of the report of ``fleet fit``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from gapbridge.bridge.report.fragment import (
    AFTER,
    BEFORE,
    FLOOR,
    Cell,
    Choice,
    Figure,
    Raw,
    bar,
    figure_block,
    html_of,
    paragraph,
    table,
)

from gapbridge.bridge.fleet.fit_summary import Fitted, FittedArm, FittedSession, FittedType
from gapbridge.bridge.fleet.outcome_words import counted
from gapbridge.bridge.fleet.report.parameter_words import parameter_words, type_words
from gapbridge.bridge.fleet.report.shared_sections import MOST, unbroken
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.bridge.report.labels import number, percent, with_unit

SESSION_HEADS = ("poses", "gap with the cell", "with the fit", "fopredicted by the others")
MICRO = 1e6
DRAWN = 80  # arms in the picture


def answer(together: Fitted) -> str:
    """Return what the fit does to the gap, and how alike the arms are."""
    parts = []
    for kind in together.types:
        sessions = [s for arm in kind.arms for s in arm.sessions]
        before, after, held = (
            float(np.sqrt(np.mean([getattr(s, name) ** 2 for s in sessions])))
            for name in ("gap_before", "gap_after", "gap_held_out")
        )
        shown = kind.scatter.shown
        spread = kind.scatter.between_arms[shown] / np.maximum(kind.scatter.mean[shown], 1e-12)
        parts.append(paragraph(
            f"{type_words(kind.name)}: {counted(len(kind.arms), 'arm')}, "
            f"{counted(len(sessions), 'session')}. With the flexibilities of the cells the gap is "
            f"{with_unit(before, 'm')} a coordinate; with those found {with_unit(after, 'm')}; a session is "
            f"predicted by the others, which did not see it, to {with_unit(held, 'm')}. The noise of "
            f"one coordinate is {with_unit(kind.scatter.noise, 'm')}."
            + (f" Arms of the type scatter by {percent(float(np.median(spread)))}." if len(spread)
               else " No session shows any flexibility."), "lead",
        ))  # fmt: skip
    return "".join(parts)


def types(together: Fitted) -> str:
    """Return a table of each type's flexibilities."""
    parts = []
    for kind in together.types:
        if len(together.types) > 1:
            parts.append(f"<h3>{html_of(type_words(kind.name))}</h3>")
        parts.append(table(
            ("flexibility", "of the type", "arms scatter by", "sessions scatter by"),
            [_parameter(kind, j) for j in range(len(kind.parameters))],
        ))  # fmt: skip
    return "".join(parts)


def _parameter(kind: FittedType, j: int) -> list[Cell]:
    scatter = kind.scatter
    if not scatter.shown[j]:
        return [parameter_words(kind.parameters[j]), "not identifiable from any session", "–", "–"]
    mean, std = scatter.mean[j] * MICRO, np.sqrt(scatter.covariance[j, j]) * MICRO
    share = [float(s[j] / max(scatter.mean[j], 1e-12))
             for s in (scatter.between_arms, scatter.between_sessions)]  # fmt: skip
    repeated = scatter.sessions > scatter.arms
    return [
        parameter_words(kind.parameters[j]), f"{number(mean)} ± {number(std, 2)} µrad/Nm",
        bar(share[0], percent(share[0]), AFTER),
        bar(share[1], percent(share[1]), FLOOR) if repeated else "–",
    ]  # fmt: skip


def arms(together: Fitted) -> str:
    """Return a picture and a table of each type's arms."""
    parts = [paragraph(
        "“Own” says how much of an arm's value comes from its own data; the rest is borrowed from "
        "the other arms of its type.", "note",
    )]  # fmt: skip
    for kind in together.types:
        if len(together.types) > 1:
            parts.append(f"<h3>{html_of(type_words(kind.name))}</h3>")
        parts.append(figure_block(_picture(kind)))
        heads = ("arm", "sessions", "poses", "own", "farthest from the type")
        parts.append(table(heads, [_arm(kind, arm) for arm in kind.arms[:MOST]]))
        if len(kind.arms) > MOST:
            more = len(kind.arms) - MOST
            parts.append(paragraph(f"{more} more are in results.parquet.", "note"))
    return "".join(parts)


def _arm(kind: FittedType, arm: FittedArm) -> list[Cell]:
    shown = np.flatnonzero(kind.scatter.shown)
    own = float(np.mean(arm.fit.own[shown])) if len(shown) else 0.0
    far = "–"
    if len(shown):
        j = int(shown[np.argmax(np.abs(arm.fit.beside_type[shown]))])
        more = arm.fit.flexibility[j] / max(kind.scatter.mean[j], 1e-12) - 1
        far = (f"{parameter_words(kind.parameters[j])}: "
               f"{percent(abs(float(more)))} {'more' if more > 0 else 'less'}")  # fmt: skip
    return [Raw(f"<b>{html_of(arm.name)}</b>"), str(len(arm.sessions)), str(arm.poses),
            bar(own, percent(own), AFTER), far]  # fmt: skip


def _drawn(kind: FittedType) -> Sequence[FittedArm]:
    """Return the arms of the picture: of many those farthest from their type."""
    if len(kind.arms) <= DRAWN:
        return kind.arms
    shown = kind.scatter.shown
    far = [float(np.max(np.abs(a.fit.beside_type[shown]), initial=0.0)) for a in kind.arms]
    return [kind.arms[i] for i in sorted(np.argsort(far)[-DRAWN:])]


def _which(drawn: Sequence[FittedArm], kind: FittedType) -> str:
    if len(drawn) == len(kind.arms):
        return "Every arm's"
    return f"The {len(drawn)} arms farthest from their type, of {len(kind.arms)}: each one's"


def _picture(kind: FittedType) -> Figure:
    """Return each arm's flexibilities with their intervals; the menu says which."""
    drawn = _drawn(kind)
    names = [arm.name for arm in drawn]
    value = np.array([arm.fit.flexibility for arm in drawn]) * MICRO
    std = np.array([arm.fit.std for arm in drawn]) * MICRO
    own = np.mean([arm.fit.own for arm in kind.arms], axis=0)
    order = sorted(
        range(len(kind.parameters)),
        key=lambda j: (not kind.scatter.shown[j], -own[j]),
    )  # fmt: skip
    mean = kind.scatter.mean * MICRO

    def band(j: int) -> list[np.ndarray[Any, np.dtype[np.float64]]]:
        low = np.maximum(value[:, j] - 1.96 * std[:, j], 0)
        return [np.column_stack([low, value[:, j] + 1.96 * std[:, j],
                                 np.full(len(names), np.nan)]).ravel(),
                value[:, j], np.full(len(names), mean[j])]  # fmt: skip

    choices = [Choice(parameter_words(kind.parameters[j]),
                      f"{parameter_words(kind.parameters[j])} (µrad/Nm)", band(j))
               for j in order]  # fmt: skip
    first = choices[0]
    traces: list[dict[str, Any]] = [
        {"type": "scatter", "mode": "lines", "name": "95 % interval", "y": first.values[0],
         "x": [n for n in names for _ in range(3)], "hoverinfo": "skip",
         "line": {"color": "#a9cbe6", "width": 5}},
        {"type": "scatter", "mode": "markers", "name": "arm", "x": names, "y": first.values[1],
         "marker": {"color": AFTER, "size": 8},
         "hovertemplate": "%{x}: %{y:.4g} µrad/Nm<extra></extra>"},
        {"type": "scatter", "mode": "lines", "name": "type", "x": names, "y": first.values[2],
         "line": {"color": BEFORE, "dash": "dot", "width": 2}, "hoverinfo": "skip"},
    ]  # fmt: skip
    return Figure(
        traces,
        {"xaxis": {"type": "category", "tickangle": -45 if len(names) > 12 else 0,
                   "automargin": True},
         "yaxis": {"title": {"text": first.title}, "rangemode": "tozero"}},
        f"{_which(drawn, kind)} flexibility with what is believed of it; the dotted line is the "
        "type.", 400,
        {"y": choices},
    )  # fmt: skip


def session_cells(together: Fitted) -> Callable[[Outcome], Sequence[Cell]]:
    """Return what writes a session's cells in the table of sessions."""
    fits: dict[str, FittedSession] = {
        s.outcome.session: s for kind in together.types for arm in kind.arms for s in arm.sessions
    }

    def cells(outcome: Outcome) -> Sequence[Cell]:
        one = fits[outcome.session]
        gaps = (one.gap_before, one.gap_after, one.gap_held_out)
        poses = str(outcome.result["evidence"]["poses"])
        return [poses, *(unbroken(with_unit(gap, "m")) for gap in gaps)]

    return cells
