"""The terms that a diagnosis adds to the model: its causes, and stand-ins fitted with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.effects import CATALOGUE, Term, totals
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model


def model_terms(channels: Sequence[ChannelDiagnosis], log: Log) -> list[Term]:
    """Return the causes' terms; of several channels (a payload) the most certain value."""
    best: dict[tuple[str, object], tuple[float, Term]] = {}
    for channel in channels:
        for cause in channel.causes:
            for term, deviation in zip(cause.terms, cause.relative_deviation, strict=True):
                key = (term.effect, term.site)
                if key not in best or deviation < best[key][0]:
                    best[key] = (deviation, term)
    return _applied([term for _, term in best.values()], log)


def terms_with_stand_ins(channels: Sequence[ChannelDiagnosis], log: Log) -> list[Term]:
    """Return the causes' terms and the stand-ins, with the values of their common fit.

    Terms of that fit that have been withdrawn since are left out.
    """
    terms = {(t.effect, t.site): t for t in model_terms(channels, log)}
    for channel in channels:
        named = {
            (t.effect, t.site)
            for cause in (*channel.causes, *channel.stand_ins)
            for t in cause.terms
        }
        together = {(t.effect, t.site): t for t in channel.fitted_together}
        terms |= {key: term for key, term in together.items() if key in named}
    return _applied(list(terms.values()), log)


def with_causes(model: Model, terms: Sequence[Term]) -> Model:
    """Return the model with the terms added to its own: what is gone is in it no more."""
    return replace(model, terms=totals((*model.terms, *terms)))


def _applied(terms: list[Term], log: Log) -> list[Term]:
    """Return the terms; steps as applied to all rows where overlapping clocks have no time of them.

    Their time is then one second before the log's.
    """
    if log.one_clock:
        return terms
    before = float(log.times()[0]) - 1.0
    return [
        replace(t, values=(*t.values[:-1], before)) if CATALOGUE[t.effect].at_moment else t
        for t in terms
    ]
