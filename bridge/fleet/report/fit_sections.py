"""Sections of the report of ``fleet fit``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, BEFORE, EDGE, PALE, Drawing
from gapbridge.bridge.document.numbers import number, percent, with_unit
from gapbridge.bridge.fleet.fit_summary import FittedArm, FittedSession, FittedType, FleetFit
from gapbridge.bridge.fleet.report.shared_sections import MAX_ROWS, type_title
from gapbridge.bridge.fleet.task import Outcome
from gapbridge.bridge.report.labels import counted, parameter_title
from gapbridge.core.arrays import Array

SESSION_HEADS = ("poses", "gap with the cell", "with the fit", "predicted by the others")
MICRO = 1e6
MAX_DRAWN = 40  # arms in the picture
NEXT_STEPS = (
    "Write each arm's flexibilities into a cell of its own with --apply FOLDER, and check one of "
    "them on a log that was not fitted: gapbridge diagnose LOG --cell CELL.",
    "Inspect arms that drift or are outliers before their cells are used.",
)


def answer(summary: FleetFit) -> list[blocks.Block]:
    """Return the gap before and after the fit, the scatter between arms, and next steps."""
    leads = [blocks.Paragraph(_lead(kind), "lead") for kind in summary.types]
    return [*leads, blocks.Heading("What to do now"), blocks.Bullets(NEXT_STEPS)]


def _lead(kind: FittedType) -> str:
    sessions = [s for arm in kind.arms for s in arm.sessions]
    before, after, held_out = (
        with_unit(float(np.sqrt(np.mean([getattr(s, name) ** 2 for s in sessions]))), "m")
        for name in ("gap_before", "gap_after", "gap_held_out")
    )
    scatter = (
        "No flexibility exceeds its own uncertainty." if kind.spread is None
        else f"Arms of the type scatter by {percent(kind.spread)}."
    )  # fmt: skip
    return (
        f"{type_title(kind.name)}: {counted(len(kind.arms), 'arm')}, "
        f"{counted(len(sessions), 'session')}. With the flexibilities of the cells the gap is "
        f"{before} rms per coordinate; with the fit {after}; of a session predicted from the "
        f"others {held_out}. The noise of one coordinate is "
        f"{with_unit(kind.scatter.noise, 'm')}. {scatter}"
    )


def _type_heading(summary: FleetFit, kind: FittedType) -> list[blocks.Block]:
    return [blocks.Heading(type_title(kind.name))] if len(summary.types) > 1 else []


def types(summary: FleetFit) -> list[blocks.Block]:
    """Return a table of flexibilities per type."""
    content: list[blocks.Block] = []
    heads = ("flexibility", "of the type", "arms scatter by", "sessions scatter by")
    for kind in summary.types:
        rows = [_parameter(kind, j) for j in range(len(kind.parameters))]
        content += [*_type_heading(summary, kind), blocks.Table(heads, rows)]
    return content


def _parameter(kind: FittedType, j: int) -> list[blocks.Cell]:
    scatter = kind.scatter
    if not scatter.identifiable[j]:
        return [parameter_title(kind.parameters[j]), "not identifiable from any session", "–", "–"]
    mean, std = scatter.mean[j] * MICRO, np.sqrt(scatter.covariance[j, j]) * MICRO
    repeated = scatter.sessions > scatter.arms
    return [
        parameter_title(kind.parameters[j]), f"{number(mean)} ± {number(std, 2)} µrad/Nm",
        _share(kind, j, scatter.between_arms, AFTER),
        _share(kind, j, scatter.between_sessions, EDGE) if repeated else "–",
    ]  # fmt: skip


def _share(kind: FittedType, j: int, scatter: Array, colour: str) -> blocks.Cell:
    """Return a scatter (2n,) of a flexibility, as a share of the type's where that has a size."""
    if not kind.has_size[j]:
        return f"{number(float(scatter[j]) * MICRO, 2)} µrad/Nm"
    share = float(scatter[j] / kind.scatter.mean[j])
    return blocks.Bar(share, percent(share), colour)


def arms(summary: FleetFit) -> list[blocks.Block]:
    """Return a picture and a table of arms per type."""
    content: list[blocks.Block] = [blocks.Paragraph(
        "“Own” is the share of an arm's value that comes from its own data, the rest from the "
        "other arms of its type.", "note",
    )]  # fmt: skip
    heads = ("arm", "sessions", "poses", "own", "farthest from the type")
    for kind in summary.types:
        content += [*_type_heading(summary, kind), _pictures(kind)]
        content.append(blocks.Table(heads, [_arm(kind, arm) for arm in kind.arms[:MAX_ROWS]]))
        if len(kind.arms) > MAX_ROWS:
            more = f"{len(kind.arms) - MAX_ROWS} more are in results.parquet."
            content.append(blocks.Paragraph(more, "note"))
    return content


def _arm(kind: FittedType, arm: FittedArm) -> list[blocks.Cell]:
    shown = np.flatnonzero(kind.scatter.identifiable)
    own = float(np.mean(arm.fit.own_share[shown])) if len(shown) else 0.0
    far = "–"
    if len(shown):
        j = int(shown[np.argmax(np.abs(arm.fit.beside_type[shown]))])
        more = float(arm.fit.flexibility[j] - kind.scatter.mean[j])
        size = (percent(abs(more) / float(kind.scatter.mean[j])) if kind.has_size[j]
                else f"{number(abs(more) * MICRO, 2)} µrad/Nm")  # fmt: skip
        far = f"{parameter_title(kind.parameters[j])}: {size} {'more' if more > 0 else 'less'}"
    return [blocks.Strong(arm.name), str(len(arm.sessions)), str(arm.poses),
            blocks.Bar(own, percent(own)), far]  # fmt: skip


def _arms_drawn(kind: FittedType) -> Sequence[FittedArm]:
    """Return the arms in the picture: if there are many, those farthest from their type."""
    if len(kind.arms) <= MAX_DRAWN:
        return kind.arms
    shown = kind.scatter.identifiable
    far = [float(np.max(np.abs(a.fit.beside_type[shown]), initial=0.0)) for a in kind.arms]
    return [kind.arms[i] for i in sorted(np.argsort(far)[-MAX_DRAWN:])]


def _arms_text(drawn: Sequence[FittedArm], kind: FittedType) -> str:
    if len(drawn) == len(kind.arms):
        return "Every arm's"
    return f"The {len(drawn)} arms farthest from their type, of {len(kind.arms)}: each one's"


def _pictures(kind: FittedType) -> blocks.Gallery:
    """Return a picture per flexibility, selected by a menu: each arm's value and interval."""
    drawn = _arms_drawn(kind)
    own = np.mean([arm.fit.own_share for arm in kind.arms], axis=0)
    known = kind.scatter.identifiable
    order = sorted(range(len(kind.parameters)), key=lambda j: (not known[j], -own[j]))
    titles = tuple(parameter_title(kind.parameters[j]) for j in order)
    return blocks.Gallery(
        (("Show", titles),), tuple(_picture(kind, drawn, j) for j in order),
        f"{_arms_text(drawn, kind)} flexibility with its 95 % interval; dashed line: the type.",
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


def session_cells(summary: FleetFit) -> Callable[[Outcome], Sequence[blocks.Cell]]:
    """Return the function that returns the table cells of a session."""
    fits: dict[str, FittedSession] = {
        s.outcome.session: s for kind in summary.types for arm in kind.arms for s in arm.sessions
    }

    def cells(outcome: Outcome) -> Sequence[blocks.Cell]:
        one = fits[outcome.session]
        gaps = (one.gap_before, one.gap_after, one.gap_held_out)
        poses = str(outcome.result["evidence"]["poses"])
        return [poses, *(with_unit(gap, "m") for gap in gaps)]

    return cells
