"""Which: all candidates with their evidence, and why the losers lost."""

from __future__ import annotations

from gapbridge.bridge.report.fragment import (
    AFTER,
    FLOOR,
    Cell,
    Raw,
    badge,
    bar,
    html_of,
    paragraph,
    table,
)
from gapbridge.bridge.report.material import Material
from gapbridge.bridge.report.words import (
    CHANNELS,
    effect_words,
    joints_words,
    likelihood,
    listed,
    percent,
)
from gapbridge.core.diagnosis.diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.result import Cause, Considered

HEADS = ("effect", "verdict", "shrinks alone", "probability", "why")


def section(material: Material) -> str:
    """Return one table per channel."""
    parts = [paragraph(
        "“Alone” says how far the gap would fall, on measurements the fit did not see, if this "
        "effect were the only one in the model. An effect can score well alone and still lose: "
        "when another explains the same better, or with fewer numbers.", "note",
    )]  # fmt: skip
    for channel in material.diagnosis.channels:
        if len(material.diagnosis.channels) > 1:
            parts.append(f"<h3>{CHANNELS[channel.channel]}</h3>")
        parts.append(_table(channel))
    return "".join(parts)


def _table(channel: ChannelDiagnosis) -> str:
    rows = [_accused(c) for c in channel.causes]
    losers = sorted(channel.considered, key=lambda k: (not k.excited, -(k.shrink_alone or 0.0)))
    tied = {name for c in channel.causes for name in c.indistinguishable_from}
    rows += [_lost(k, channel, k.effect in tied) for k in losers]
    return table(HEADS, rows)


def _name(effect: str, joints: tuple[int, ...] = ()) -> Raw:
    where = f", {joints_words(joints)}" if joints else ""
    return Raw(f"<b>{html_of(effect_words(effect))}</b>{where}<br><code>{html_of(effect)}</code>")


def _accused(cause: Cause) -> list[Cell]:
    why = "needed: without it the gap stays larger"
    if cause.shrink is not None:
        low, high = cause.shrink.interval
        why = (
            f"with it in the model the gap falls by a further {percent(cause.shrink.shrink)} "
            f"({percent(low)} to {percent(high)})"
        )
    if cause.indistinguishable_from:
        ties = listed([effect_words(n) for n in cause.indistinguishable_from], "or")
        why += f"; these data cannot separate it from: {ties}"
    word = badge("cause, tied", "doubtful") if cause.indistinguishable_from else badge(
        "cause", "good")  # fmt: skip
    alone = bar(cause.shrink_alone, percent(cause.shrink_alone), AFTER)
    return [_name(cause.effect, cause.joints), word, alone, likelihood(cause.probability), why]


def _lost(considered: Considered, channel: ChannelDiagnosis, tied: bool) -> list[Cell]:
    if not considered.excited:
        need = considered.reason.removeprefix("not excited; needs ")
        return [_name(considered.effect), badge("cannot be seen", "quiet"), "–", "–",
                f"this log does not show it; it needs {need}"]  # fmt: skip
    word = badge("tied", "doubtful") if tied else badge("no", "quiet")
    why = considered.reason
    withdrawn = not why.startswith("does not pay")
    if not withdrawn:
        why = (
            "explains too little more, beside the causes found, for the numbers it adds"
            if channel.causes else "explains too little for the numbers it adds"
        )  # fmt: skip
    elif not tied:
        word = badge("withdrawn", "doubtful")
        why = f"looked like a cause, but is not accused: {why}"
    if tied:
        why = "would explain these data as well as the cause named above"
    alone: Cell = "–"
    if considered.shrink_alone is not None:
        alone = bar(considered.shrink_alone, percent(considered.shrink_alone), FLOOR)
    return [_name(considered.effect), word, alone, likelihood(considered.probability), why]
