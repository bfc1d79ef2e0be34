"""Sections of the report of ``fleet fit``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, PALE, Drawing
from gapbridge.bridge.fleet.fit_summary import Fitted, FittedArm, FittedSession, FittedType
from gapbridge.bridge.fleet.report.shared_sections import MOST, type_title
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.bridge.report.labels import counted, number, parameter_title, percent, with_unit

SESSION_HEADS = ("poses", "gap with the cell", "with the fit", "predicted by the others")
MICRO = 1e6
DRAWN = 40  # arms in the picture
NEXT_STEPS = (
    "Write each arm's flexibilities into a cell of its own with --cells FOLDER, and check one of "
    "them on a log that was not fitted: gapbridge diagnose LOG --cell CELL.",
    "Look at the arms that drift or stand out before their cells are used.",
)


def answer(together: Fitted) -> list[blocks.Block]:
    """Return what the fit does to the gap, how alike the arms are, and what to do."""
    leads = [blocks.Paragraph(_lead(kind), "lead") for kind in together.types]
    return [*leads, blocks.Heading("What to do now"), blocks.Bullets(NEXT_STEPS)]


def _lead(kind: FittedType) -> str:
    sessions = [s for arm in kind.arms for s in arm.sessions]
    before, after, held = (
        with_unit(float(np.sqrt(np.mean([getattr(s, name) ** 2 for s in sessions]))), "m")
        for name in ("gap_before", "gap_after", "gap_held_out")
    )
    shown = kind.scatter.identifiable
    spread = kind.scatter.between_arms[shown] / np.maximum(kind.scatter.mean[shown], 1e-12)
    alike = (
        f"Arms of the type scatter by {percent(float(np.median(spread)))}." if len(spread)
        else "No session shows any flexibility."
    )  # fmt: skip
    return (
        f"{type_title(kind.name)}: {counted(len(kind.arms), 'arm')}, "
        f"{counted(len(sessions), 'session')}. With the flexibilities of the cells the gap is "
        f"{before} a coordinate; with those found {after}; a session is predicted by the others, "
        f"which did not see it, to {held}. The noise of one coordinate is "
        f"{with_unit(kind.scatter.noise, 'm')}. {alike}"
    )


def _type_heading(together: Fitted, kind: FittedType) -> list[blocks.Block]:
    return [blocks.Heading(type_title(kind.name))] if len(together.types) > 1 else []


def types(together: Fitted) -> list[blocks.Block]:
    """Return a table of each type's flexibilities."""
    content: list[blocks.Block] = []
    heads = ("flexibility", "of the type", "arms scatter by", "sessions scatter by")
    for kind in together.types:
        rows = [_parameter(kind, j) for j in range(len(kind.parameters))]
        content += [*_type_heading(together, kind), blocks.Table(heads, rows)]
    return content


def _parameter(kind: FittedType, j: int) -> list[blocks.Cell]:
    scatter = kind.scatter
    if not scatter.identifiable[j]:
        return [parameter_title(kind.parameters[j]), "not identifiable from any session", "–", "–"]
    mean, std = scatter.mean[j] * MICRO, np.sqrt(scatter.covariance[j, j]) * MICRO
    share = [float(s[j] / max(scatter.mean[j], 1e-12))
             for s in (scatter.between_arms, scatter.between_sessions)]  # fmt: skip
    repeated = scatter.sessions > scatter.arms
    return [
        parameter_title(kind.parameters[j]), f"{number(mean)} ± {number(std, 2)} µrad/Nm",
        blocks.Bar(share[0], percent(share[0])),
        blocks.Bar(share[1], percent(share[1]), EDGE) if repeated else "–",
    ]  # fmt: skip


def arms(together: Fitted) -> list[blocks.Block]:
    """Return a picture and a table of each type's arms."""
    content: list[blocks.Block] = [blocks.Paragraph(
        "“Own” says how much of an arm's value comes from its own data; the rest is borrowed from "
        "the other arms of its type.", "note",
    )]  # fmt: skip
    heads = ("arm", "sessions", "poses", "own", "farthest from the type")
    for kind in together.types:
        content += [*_type_heading(together, kind), _pictures(kind)]
        content.append(blocks.Table(heads, [_arm(kind, arm) for arm in kind.arms[:MOST]]))
        if len(kind.arms) > MOST:
            more = f"{len(kind.arms) - MOST} more are in results.parquet."
            content.append(blocks.Paragraph(more, "note"))
    return content


def _arm(kind: FittedType, arm: FittedArm) -> list[blocks.Cell]:
    shown = np.flatnonzero(kind.scatter.identifiable)
    own = float(np.mean(arm.fit.own_share[shown])) if len(shown) else 0.0
    far = "–"
    if len(shown):
        j = int(shown[np.argmax(np.abs(arm.fit.beside_type[shown]))])
        more = arm.fit.flexibility[j] / max(kind.scatter.mean[j], 1e-12) - 1
        far = (f"{parameter_title(kind.parameters[j])}: "
               f"{percent(abs(float(more)))} {'more' if more > 0 else 'less'}")  # fmt: skip
    return [blocks.Strong(arm.name), str(len(arm.sessions)), str(arm.poses),
            blocks.Bar(own, percent(own)), far]  # fmt: skip


def _drawn(kind: FittedType) -> Sequence[FittedArm]:
    """Return the arms of the picture: of many those farthest from their type."""
    if len(kind.arms) <= DRAWN:
        return kind.arms
    shown = kind.scatter.identifiable
    far = [float(np.max(np.abs(a.fit.beside_type[shown]), initial=0.0)) for a in kind.arms]
    return [kind.arms[i] for i in sorted(np.argsort(far)[-DRAWN:])]


def _which(drawn: Sequence[FittedArm], kind: FittedType) -> str:
    if len(drawn) == len(kind.arms):
        return "Every arm's"
    return f"The {len(drawn)} arms farthest from their type, of {len(kind.arms)}: each one's"


def _pictures(kind: FittedType) -> blocks.Gallery:
    """Return each arm's flexibilities with their intervals; the menu says which."""
    drawn = _drawn(kind)
    own = np.mean([arm.fit.own_share for arm in kind.arms], axis=0)
    known = kind.scatter.identifiable
    order = sorted(range(len(kind.parameters)), key=lambda j: (not known[j], -own[j]))
    titles = tuple(parameter_title(kind.parameters[j]) for j in order)
    return blocks.Gallery(
        (("Show", titles),), tuple(_picture(kind, drawn, j) for j in order),
        f"{_which(drawn, kind)} flexibility with its 95 % interval; the dashed line is the type.",
    )  # fmt: skip


def _picture(kind: FittedType, drawn: Sequence[FittedArm], j: int) -> Drawing:
    value = np.array([arm.fit.flexibility[j] for arm in drawn]) * MICRO
    side = 1.96 * MICRO * np.array([arm.fit.std[j] for arm in drawn])
    step = max(1, len(drawn) // 8)
    labels = [arm.name if i % step == 0 else "" for i, arm in enumerate(drawn)]
    chart = Chart(
        parameter_title(kind.parameters[j]), named("arm", labels),
        scale("µrad/Nm", [*value, *(value + side)]), width=430, height=260,
    )  # fmt: skip
    for i, arm in enumerate(drawn):
        band = [max(float(value[i] - side[i]), 0.0), float(value[i] + side[i])]
        chart.line([i, i], band, PALE, width=5)
        chart.points([i], [value[i]], AFTER, radius=3.2, opacity=1.0,
                     hints=[f"{arm.name}: {number(value[i])} µrad/Nm"])  # fmt: skip
    chart.level(float(kind.scatter.mean[j]) * MICRO, "type", BEFORE)
    return chart.drawing


def session_cells(together: Fitted) -> Callable[[Outcome], Sequence[blocks.Cell]]:
    """Return the function that gives a session's cells in the table of sessions."""
    fits: dict[str, FittedSession] = {
        s.outcome.session: s for kind in together.types for arm in kind.arms for s in arm.sessions
    }

    def cells(outcome: Outcome) -> Sequence[blocks.Cell]:
        one = fits[outcome.session]
        gaps = (one.gap_before, one.gap_after, one.gap_held_out)
        poses = str(outcome.result["evidence"]["poses"])
        return [poses, *(with_unit(gap, "m") for gap in gaps)]

    return cells
