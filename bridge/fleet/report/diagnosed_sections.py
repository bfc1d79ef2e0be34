"""Sections of the report of ``fleet diagnose``."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.document import blocks
from gapbridge.bridge.document.axes import Chart, named, scale
from gapbridge.bridge.document.drawing import AFTER, LIMIT, PALE, Drawing
from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed, Onset, Recurrence
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import natural
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.report.answer import KINDS
from gapbridge.bridge.report.labels import (
    VERDICTS,
    counted,
    effect_title,
    joint_list,
    listed,
    percent,
    with_unit,
)
from gapbridge.core.diagnosis.channel_diagnosis import Verdict

SESSION_HEADS = ("verdict", "samples", "gap", "unexplained", "causes")
JOINTS = 4  # named of an effect's joints
NAMED = 4  # drifting arms in the answer
DRAWN = 14  # effects in the picture


def answer(together: Diagnosed, done: Done) -> list[blocks.Block]:
    """Return verdicts, what recurs, drifts and stands out in a few sentences, and what to do."""
    usable = sum(o.state == DONE for o in done.outcomes)
    first, *rest = (
        blocks.Badge(f"{VERDICTS[verdict]}: {count}", KINDS[verdict])
        for verdict, count in together.verdicts
    )
    sentences = [
        _recurs(together),
        _drifting(together),
        _standing_out(together),
        _skipped(done, usable),
    ]
    text = " ".join(s for s in sentences if s)
    return [
        blocks.Verdict(first, text, tuple(rest)), blocks.Heading("What to do now"),
        blocks.Bullets(tuple(_next_steps(together, done, usable))),
    ]  # fmt: skip


def _next_steps(together: Diagnosed, done: Done, usable: int) -> list[str]:
    steps = []
    if usable < len(done.outcomes):
        steps.append("Mend or remove the logs that were skipped (“Sessions” says why).")
    if together.drifts or together.onsets:
        steps.append("Inspect the arms that drift, the surest first: something wears or loosens.")
    if together.outliers:
        steps.append("Diagnose the sessions that stand out one by one, with gapbridge diagnose.")
    if together.recurrences:
        steps.append(
            "Put what recurs in all arms of a type into their cells, with gapbridge diagnose "
            "--apply or, for flexibilities, gapbridge fleet fit --cells."
        )
    return steps or ["Nothing: no session shows an effect, a drift or an outlier."]


def _recurs(together: Diagnosed) -> str:
    often = [r for r in together.recurrences if r.sessions > 0.1 * r.looked][:3]
    if not together.recurrences:
        return "No effect is accused in any session."
    if not often:
        return "No effect recurs: none is accused in more than a tenth of the sessions."
    often_named = [f"{effect_title(r.effect)} ({r.arms} of {counted(r.arms_looked, 'arm')})"
             for r in often]  # fmt: skip
    return f"What recurs most: {listed(often_named)}."


def _drifting(together: Diagnosed) -> str:
    arms = sorted({d.arm for d in together.drifts} | {o.arm for o in together.onsets}, key=natural)
    if not arms:
        return "No arm drifts by more than its sessions scatter."
    who = listed(arms) if len(arms) <= NAMED else counted(len(arms), "arm")
    return f"{who} {'drifts' if len(arms) == 1 else 'drift'}."


def _standing_out(together: Diagnosed) -> str:
    if not together.outliers:
        return ""
    first = together.outliers[0]
    more = f" and {len(together.outliers) - 1} more" if len(together.outliers) > 1 else ""
    verb = "stand" if more else "stands"
    return f"{first.session or first.arm}{more} {verb} out."


def _skipped(done: Done, usable: int) -> str:
    left = len(done.outcomes) - usable
    return f"{counted(left, 'session')} could not be used." if left else ""


def recurring(together: Diagnosed) -> list[blocks.Block]:
    """Return the effects with how often they recur."""
    if not together.recurrences:
        return [blocks.Paragraph("No effect is accused in any session.")]
    caption = (
        "Share of the sessions, and of the arms, in which the effect is accused, of those whose "
        "logs could show it."
    )
    heads = ("effect", "sessions", "arms", "always in", "joints (sessions)", "takes off the gap")
    return [
        blocks.Pictures((_picture(together.recurrences[:DRAWN]),), caption),
        blocks.Table(heads, [_row(r) for r in together.recurrences]),
    ]


def _row(one: Recurrence) -> list[blocks.Cell]:
    joints = [f"{j} ({n})" for j, n in one.joints[:JOINTS]]
    tied = f", {one.tied} tied" if one.tied else ""
    return [
        blocks.Named(effect_title(one.effect), code=f"{one.effect}, {one.channel}"),
        blocks.Bar(one.sessions / one.looked, f"{one.sessions} of {one.looked}{tied}"),
        blocks.Bar(one.arms / one.arms_looked, f"{one.arms} of {one.arms_looked}"),
        counted(one.always, "arm"),
        ", ".join(joints) + (" …" if len(one.joints) > JOINTS else "") or "–",
        blocks.Bar(one.shrink, percent(one.shrink), LIMIT),
    ]


def _picture(found: Sequence[Recurrence]) -> Drawing:
    shown = list(reversed(found))
    # an effect that two channels show stands once for each
    labels = [
        effect_title(r.effect) + ("" if r.channel == "position" else f" ({r.channel})")
        for r in shown
    ]
    left = 16 + 5.4 * max(len(label) for label in labels)
    chart = Chart("", scale("share that has it, %", [0, 100]), named("", labels),
                  width=left + 300, height=80 + 30.0 * len(shown), left=left)  # fmt: skip
    for i, r in enumerate(shown):
        chart.bar(i + 0.18, 100 * r.sessions / r.looked, AFTER, 0.32, f"{r.sessions} sessions")
        chart.bar(i - 0.18, 100 * r.arms / r.arms_looked, PALE, 0.32, f"{r.arms} arms")
    chart.legend((("of sessions", AFTER), ("of arms", PALE)))
    return chart.drawing


def onsets(found: Sequence[Onset]) -> list[blocks.Block]:
    """Return the effects that arms have from some session on."""
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
    """Return a session's cells in the table of sessions, of its first channel."""
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
