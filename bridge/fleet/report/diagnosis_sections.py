"""Sections of the report of ``fleet diagnose``."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, LIMIT, PALE, Drawing
from gapbridge.bridge.document.numbers import percent, with_unit
from gapbridge.bridge.fleet.diagnosis_summary import FleetDiagnosis, Onset, Recurrence
from gapbridge.bridge.fleet.runner import FleetRun
from gapbridge.bridge.fleet.session import natural_key
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.report.answer import KINDS
from gapbridge.bridge.report.labels import VERDICTS, counted, effect_title, joint_list, listed
from gapbridge.core.diagnosis.channel_diagnosis import Verdict

SESSION_HEADS = ("verdict", "samples", "gap", "unexplained", "causes")
MAX_JOINTS = 4  # named per effect
MAX_NAMED = 4  # drifting arms in the answer
MAX_DRAWN = 14  # effects in the picture


def answer(summary: FleetDiagnosis, done: FleetRun) -> list[blocks.Block]:
    """Return verdicts, a summary of recurring effects, drifts and outliers, and next steps."""
    usable = sum(o.state == DONE for o in done.outcomes)
    first, *rest = (
        blocks.Badge(f"{VERDICTS[verdict]}: {count}", KINDS[verdict])
        for verdict, count in summary.verdicts
    )
    sentences = [_recurs(summary), _drifting(summary), _outliers(summary), _skipped(done, usable)]
    text = " ".join(s for s in sentences if s)
    return [
        blocks.Verdict(first, text, tuple(rest)), blocks.Heading("What to do now"),
        blocks.Bullets(tuple(_next_steps(summary, done, usable))),
    ]  # fmt: skip


def _next_steps(summary: FleetDiagnosis, done: FleetRun, usable: int) -> list[str]:
    steps = []
    if usable < len(done.outcomes):
        steps.append("Repair or remove the logs that were skipped (reasons: “Sessions”).")
    if summary.drifts or summary.onsets:
        steps.append(
            "Inspect the arms that drift, the most significant first: parts wear or loosen."
        )
    if summary.outliers:
        steps.append("Diagnose each outlier on its own, with gapbridge diagnose.")
    if summary.recurrences:
        steps.append(
            "Add effects that recur in all arms of a type to their cells, with gapbridge diagnose "
            "--apply or, for flexibilities, gapbridge fleet fit --apply."
        )
    return steps or ["Nothing: no session shows an effect, a drift or an outlier."]


def _recurs(summary: FleetDiagnosis) -> str:
    often = [r for r in summary.recurrences if r.sessions > 0.1 * r.observable][:3]
    if not summary.recurrences:
        return "No effect is named in any session."
    if not often:
        return "No effect recurs: none is named in more than a tenth of the sessions."
    often_named = [f"{effect_title(r.effect)} ({r.arms} of {counted(r.arms_observable, 'arm')})"
             for r in often]  # fmt: skip
    return f"Most frequent effects: {listed(often_named)}."


def _drifting(summary: FleetDiagnosis) -> str:
    arms = sorted(
        {d.arm for d in summary.drifts} | {o.arm for o in summary.onsets}, key=natural_key
    )
    if not arms:
        return "No arm drifts significantly."
    who = listed(arms) if len(arms) <= MAX_NAMED else counted(len(arms), "arm")
    return f"{who} {'drifts' if len(arms) == 1 else 'drift'}."


def _outliers(summary: FleetDiagnosis) -> str:
    if not summary.outliers:
        return ""
    first = summary.outliers[0]
    more = f" and {len(summary.outliers) - 1} more" if len(summary.outliers) > 1 else ""
    verb = "are outliers" if more else "is an outlier"
    return f"{first.session or first.arm}{more} {verb}."


def _skipped(done: FleetRun, usable: int) -> str:
    skipped = len(done.outcomes) - usable
    return f"{counted(skipped, 'session')} could not be used." if skipped else ""


def recurring(summary: FleetDiagnosis) -> list[blocks.Block]:
    """Return a picture and a table of how often each effect is named."""
    if not summary.recurrences:
        return [blocks.Paragraph("No effect is named in any session.")]
    caption = (
        "Share of the sessions, and of the arms, in which the effect is named, of those whose "
        "logs could show it."
    )
    heads = ("effect", "sessions", "arms", "always in", "joints (sessions)", "share of the gap")
    return [
        blocks.Pictures((_picture(summary.recurrences[:MAX_DRAWN]),), caption),
        blocks.Table(heads, [_row(r) for r in summary.recurrences]),
    ]


def _row(one: Recurrence) -> list[blocks.Cell]:
    joints = [f"{j} ({n})" for j, n in one.joints[:MAX_JOINTS]]
    tied = f", {one.tied} tied" if one.tied else ""
    return [
        blocks.Named(effect_title(one.effect), code=f"{one.effect}, {one.channel}"),
        blocks.Bar(one.sessions / one.observable, f"{one.sessions} of {one.observable}{tied}"),
        blocks.Bar(one.arms / one.arms_observable, f"{one.arms} of {one.arms_observable}"),
        counted(one.always, "arm"),
        ", ".join(joints) + (" …" if len(one.joints) > MAX_JOINTS else "") or "–",
        blocks.Bar(one.shrink, percent(one.shrink), LIMIT),
    ]


def _picture(recurrences: Sequence[Recurrence]) -> Drawing:
    rows = list(reversed(recurrences))
    # one row per channel
    labels = [
        effect_title(r.effect) + ("" if r.channel == "position" else f" ({r.channel})")
        for r in rows
    ]
    left = 16 + 5.4 * max(len(label) for label in labels)
    chart = Chart("", scale("share with the effect, %", [0, 100]), named("", labels),
                  width=left + 300, height=80 + 30.0 * len(rows), left=left)  # fmt: skip
    for i, r in enumerate(rows):
        chart.bar(i + 0.18, 100 * r.sessions / r.observable, AFTER, 0.32, f"{r.sessions} sessions")
        chart.bar(i - 0.18, 100 * r.arms / r.arms_observable, PALE, 0.32, f"{r.arms} arms")
    chart.legend((("of sessions", AFTER), ("of arms", PALE)))
    return chart.drawing


def onsets(found: Sequence[Onset]) -> list[blocks.Block]:
    """Return the table of effects that arms have from some session on."""
    if not found:
        return []
    rows: list[list[blocks.Cell]] = [
        [blocks.Strong(o.arm), effect_title(o.effect), o.since.removeprefix(f"{o.arm}/"),
         f"{counted(o.before, 'session')} without, {o.after} with"]
        for o in found
    ]  # fmt: skip
    heads = ("arm", "effect", "since session", "")
    return [blocks.Heading("Effects that set in"), blocks.Table(heads, rows)]


def session_cells(outcome: Outcome) -> list[blocks.Cell]:
    """Return the table cells of a session: its verdict, and its first channel."""
    result = outcome.result
    verdict, channel = Verdict(result["verdict"]), result["channels"][0]
    causes = {(r["effect"], tuple(r["joints"])) for r in result["rows"] if r["accused"]}
    named_causes = [
        f"{effect_title(e)}{', ' + joint_list(j) if j else ''}" for e, j in sorted(causes)
    ]
    return [
        blocks.Badge(VERDICTS[verdict], KINDS[verdict]),
        str(channel["samples"]), with_unit(channel["gap_rms"], channel["unit"]),
        with_unit(channel["remaining_rms"], channel["unit"]), "; ".join(named_causes) or "–",
    ]  # fmt: skip
