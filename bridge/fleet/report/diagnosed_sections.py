"""Sections of the report of ``fleet diagnose``."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

from gapbridge.bridge.report.fragment import (
    AFTER,
    EXPLAINED,
    Cell,
    Figure,
    Raw,
    badge,
    bar,
    figure_block,
    html_of,
    paragraph,
    table,
)

from gapbridge.bridge.fleet.diagnosis_summary import Diagnosed, Onset, Recurrence
from gapbridge.bridge.fleet.outcome_words import counted
from gapbridge.bridge.fleet.report.shared_sections import unbroken
from gapbridge.bridge.fleet.runner import Done
from gapbridge.bridge.fleet.session import natural
from gapbridge.bridge.fleet.task import DONE, Outcome
from gapbridge.bridge.report.labels import (
    CHANNELS,
    VERDICTS,
    effect_title,
    joint_list,
    listed,
    percent,
    with_unit,
)  # fmt: skip

KINDS = {"no_gap": "good", "explained": "good", "partly_explained": "doubtful",
         "unexplained": "bad"}  # fmt: skip
SESSION_HEADS = ("verdict", "samples", "gap", "unexplained", "causes")
JOINTS = 4  # named of an effect's joints
NAMED = 4  # drifting arms in the answer
DRAWN = 14  # effects in the picture


def answer(together: Diagnosed, done: Done) -> str:
    """Return verdicts, and in a few sentences what recurs, drifts and stands out."""
    usable = sum(o.state == DONE for o in done.outcomes)
    words = "".join(
        f" {html_of(badge(f'{VERDICTS[verdict]}: {count}', KINDS[verdict]))}"
        for verdict, count in together.verdicts
    )
    parts = [f'<p class="verdict">{words}</p>']
    sentences = [
        _recurs(together),
        _drifting(together),
        _standing_out(together),
        _skipped(done, usable),
    ]
    parts.append(paragraph(" ".join(s for s in sentences if s), "lead"))
    return "".join(parts)


def _recurs(together: Diagnosed) -> str:
    often = [r for r in together.recurrences if r.sessions > 0.1 * r.looked][:3]
    if not together.recurrences:
        return "No effect is accused in any session."
    if not often:
        return "No effect recurs: none is accused in more than a tenth of the sessions."
    told_ = [f"{effect_title(r.effect)} ({r.arms} of {counted(r.arms_looked, 'arm')})"
             for r in often]  # fmt: skip
    return f"What recurs most: {listed(told_)}."


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


def recurring(together: Diagnosed) -> str:
    """Return the effects with how often they recur."""
    if not together.recurrences:
        return paragraph("No effect is accused in any session.")
    rows = [_row(r) for r in together.recurrences]
    heads = ("effect", "sessions", "arms", "always in", "joints (sessions)", "takes off the gap")
    return figure_block(_picture(together.recurrences[:DRAWN])) + table(heads, rows)


def _row(one: Recurrence) -> list[Cell]:
    joints = [f"{j} ({n})" for j, n in one.joints[:JOINTS]]
    tied = f", {one.tied} tied" if one.tied else ""
    return [
        Raw(f"<b>{html_of(effect_title(one.effect))}</b><br>"
            f"<code>{html_of(one.effect)}</code> · {html_of(CHANNELS[one.channel].lower())}"),
        bar(one.sessions / one.looked, f"{one.sessions} of {one.looked}{tied}", AFTER),
        bar(one.arms / one.arms_looked, f"{one.arms} of {one.arms_looked}", AFTER),
        f"{counted(one.always, 'arm')}",
        ", ".join(joints) + (" …" if len(one.joints) > JOINTS else "") or "–",
        bar(one.shrink, percent(one.shrink), EXPLAINED),
    ]  # fmt: skip


def _picture(found: Sequence[Recurrence]) -> Figure:
    shown = list(reversed(found))
    # an effect that two channels show stands once for each
    names = [_label(r) for r in shown]
    traces = [
        {"type": "bar", "orientation": "h", "name": title, "y": names, "x": values,
         "marker": {"color": colour}, "hovertemplate": "%{y}: %{x:.0f} %<extra></extra>"}
        for title, values, colour in (
            ("of sessions", [100 * r.sessions / r.looked for r in shown], AFTER),
            ("of arms", [100 * r.arms / r.arms_looked for r in shown], "#a9cbe6"),
        )
    ]  # fmt: skip
    return Figure(
        traces,
        {"xaxis": {"title": {"text": "share that has it (%)"}, "range": [0, 102]},
         "yaxis": {"automargin": True}, "barmode": "group", "bargap": 0.35,
         "margin": {"l": 10, "r": 16, "t": 30, "b": 44}},
        "Share of the sessions, and of the arms, in which the effect is accused, of those whose "
        "logs could show it.", 110 + 44 * len(shown),
    )  # fmt: skip


def _label(one: Recurrence) -> str:
    """Return an effect's name in lines that a phone has room for."""
    words = effect_title(one.effect) + ("" if one.channel == "position" else f" ({one.channel})")
    return "<br>".join(textwrap.wrap(words, 20))


def onsets(found: Sequence[Onset]) -> str:
    """Return the effects that arms have from some session on."""
    if not found:
        return ""
    rows: list[list[Cell]] = [
        [Raw(f"<b>{html_of(o.arm)}</b>"), effect_title(o.effect),
         o.since.removeprefix(f"{o.arm}/"),
         f"{counted(o.before, 'session')} without, {o.after} with"]
        for o in found
    ]  # fmt: skip
    return "<h3>Effects that set in</h3>" + table(("arm", "effect", "since session", ""), rows)


def session_cells(outcome: Outcome) -> list[Cell]:
    """Return a session's cells in the table of sessions, of its first channel."""
    result = outcome.result
    channel = result["channels"][0]
    causes = {(r["effect"], tuple(r["joints"])) for r in result["rows"] if r["accused"]}
    words = [f"{effect_title(e)}{', ' + joint_list(j) if j else ''}" for e, j in sorted(causes)]
    return [
        badge(VERDICTS[result["verdict"]], KINDS[result["verdict"]]),
        str(channel["samples"]), unbroken(with_unit(channel["gap_rms"], channel["unit"])),
        unbroken(with_unit(channel["remaining_rms"], channel["unit"])), "; ".join(words) or "–",
    ]  # fmt: skip
