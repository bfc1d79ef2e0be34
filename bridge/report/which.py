"""Which: all candidates with their evidence, and why the losers lost."""

from __future__ import annotations

from gapbridge.bridge.document.blocks import (
    DOUBTFUL,
    GOOD,
    QUIET,
    Badge,
    Bar,
    Block,
    Cell,
    Named,
    Paragraph,
    Table,
)
from gapbridge.bridge.document.drawing import EDGE
from gapbridge.bridge.document.findings import considered_text
from gapbridge.bridge.report.labels import effect_title, joint_list, likelihood, listed, percent
from gapbridge.bridge.report.material import Material, channel_heading
from gapbridge.core.diagnosis.causes import Cause, Considered, Outcome
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis

HEADS = ("effect", "verdict", "shrinks alone", "probability", "why")
NOTE = (
    "“Alone” says how far the gap would fall, on measurements the fit did not see, if this effect "
    "were the only one in the model. An effect can score well alone and still lose: when another "
    "explains the same better, or with fewer numbers."
)


def which(material: Material) -> list[Block]:
    """Return one table per channel."""
    blocks: list[Block] = [Paragraph(NOTE, "note")]
    for channel in material.diagnosis.channels:
        blocks += [*channel_heading(material.diagnosis, channel), _table(channel)]
    return blocks


def _table(channel: ChannelDiagnosis) -> Table:
    rows = [_accused(c) for c in channel.causes]
    losers = sorted(channel.considered, key=lambda k: (not k.excited, -(k.shrink_alone or 0.0)))
    tied = {name for c in channel.causes for name in c.indistinguishable_from}
    rows += [_considered(k, k.effect in tied, bool(channel.causes)) for k in losers]
    return Table(HEADS, rows, (2.2, 1.1, 1.1, 0.9, 3))


def _name(effect: str, joints: tuple[int, ...] = ()) -> Named:
    return Named(effect_title(effect), f", {joint_list(joints)}" if joints else "", effect)


def _accused(cause: Cause) -> list[Cell]:
    why = "needed: without it the gap stays larger"
    if cause.shrink is not None:
        low, high = cause.shrink.interval
        why = (
            f"with it in the model the gap falls by a further {percent(cause.shrink.shrink)} "
            f"({percent(low)} to {percent(high)})"
        )
    if cause.indistinguishable_from:
        ties = listed([effect_title(n) for n in cause.indistinguishable_from], "or")
        why += f"; these data cannot separate it from: {ties}"
    tied = bool(cause.indistinguishable_from)
    verdict = Badge("cause, tied", DOUBTFUL) if tied else Badge("cause", GOOD)
    alone = Bar(cause.shrink_alone, percent(cause.shrink_alone))
    return [_name(cause.effect, cause.joints), verdict, alone, likelihood(cause.probability), why]


def _considered(considered: Considered, tied: bool, beside: bool) -> list[Cell]:
    """Return the row of an effect that is not accused; ``beside``: others are."""
    if considered.outcome is Outcome.NOT_EXCITED:
        why = f"this log does not show it; it needs {considered.needs}"
        return [_name(considered.effect), Badge("not excited", QUIET), "–", "–", why]
    if tied:
        verdict = Badge("tied", DOUBTFUL)
        why = "would explain these data as well as the cause named above"
    elif considered.outcome is Outcome.WITHDRAWN:
        verdict = Badge("withdrawn", DOUBTFUL)
        why = f"looked like a cause, but is not accused: {considered_text(considered)}"
    else:
        verdict = Badge("no", QUIET)
        others = ", beside the causes found," if beside else ""
        why = f"explains too little{' more' if beside else ''}{others} for the numbers it adds"
    alone: Cell = "–"
    if considered.shrink_alone is not None:
        alone = Bar(considered.shrink_alone, percent(considered.shrink_alone), EDGE)
    return [_name(considered.effect), verdict, alone, likelihood(considered.probability), why]
