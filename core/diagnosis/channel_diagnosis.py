"""The diagnosis of one channel of a log, and the terms that diagnoses add to a model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.across_sessions import SessionTransfer
from gapbridge.core.diagnosis.causes import Cause, Considered
from gapbridge.core.diagnosis.generalisation import NO_GENERALISATION, Generalisation
from gapbridge.core.diagnosis.judgement import Judgement
from gapbridge.core.diagnosis.residual_structure import dependence
from gapbridge.core.diagnosis.selection.candidate import joint_target
from gapbridge.core.diagnosis.selection.selection import Selection
from gapbridge.core.effects import CATALOGUE, Reported, Term, totals
from gapbridge.core.estimation.least_squares import basis_of
from gapbridge.core.log.log import Log
from gapbridge.core.model import Model
from gapbridge.core.sessions import session_of


class Verdict(StrEnum):
    """The verdict on one channel or on all; the values are those of the JSON."""

    NO_GAP = "no_gap"
    EXPLAINED = "explained"
    PARTLY_EXPLAINED = "partly_explained"
    UNEXPLAINED = "unexplained"


@dataclass(frozen=True)
class Where:
    """Where a gap lies, as shares of its sum of squares."""

    joints: tuple[tuple[int, float], ...]  # joint from 1, share of the gap's energy; largest first
    axes: tuple[float, ...]
    depends_on: tuple[tuple[str, float], ...]  # quantity, held-out R2


@dataclass(frozen=True)
class ChannelDiagnosis:
    """The diagnosis of one channel; figures per coordinate, in the channel's unit."""

    channel: str
    unit: str
    samples: int
    gap_rms: float
    gap_max: float
    noise_floor_rms: float | None
    remaining_rms: float
    remaining_rms_held_out: float | None
    where: Where
    causes: tuple[Cause, ...]
    considered: tuple[Considered, ...]
    unexplained_rms: float
    structured: bool
    p_value: float | None
    depends_on: tuple[tuple[str, float], ...]
    verdict: Verdict
    selection: Selection = field(repr=False)  # of a long recording: on its excerpt
    judgement: Judgement = field(repr=False)
    gap: Array = field(repr=False)  # (N, k) measured - predicted, frame fitted
    remaining: Array = field(repr=False)  # (N, k) with the causes in the model
    held_out: Array | None = field(repr=False)  # (kept,) rms of each held-out sample
    outliers: NDArray[np.int64] = field(repr=False)  # rows of the log that were excluded
    stand_ins: tuple[Cause, ...] = ()  # not accused, but reduce the gap in regions not fitted
    fitted_together: tuple[Term, ...] = ()  # causes and stand-ins
    generalisation: Generalisation = NO_GENERALISATION  # new region, new session
    noise_floor_source: str = "unknown"  # see Floor
    session_transfer: tuple[SessionTransfer, ...] = ()  # of causes, for several sessions


def locate(selection: Selection, gap: Array, accused: Sequence[int]) -> Where:
    """Return where the gap (N, k) of the kept samples lies.

    ``accused`` are candidate indices: their joints share the part that they explain. Without any,
    each joint's share is what an unnamed function of its own angle error could explain.
    """
    space = selection.space
    own = gap[:, : min(gap.shape[1], 3)] if selection.observation.channel in (
        "position", "wrench") else gap  # fmt: skip
    energy = np.sum(own**2, axis=0)
    axes = tuple(float(v) for v in energy / max(float(energy.sum()), 1e-300))
    total = max(float(space.y @ space.y), 1e-300)
    shares: dict[int, float] = {}
    if accused:
        values = selection.fitted(accused)
        for c in accused:
            joint = space.candidates[c].site.joint
            if joint is not None:
                part = space.X[:, space.start[c] : space.start[c + 1]] @ values[c]
                # projection of the gap on this part: the parts then add up
                shares[joint] = shares.get(joint, 0.0) + float(part @ space.y) / total
    else:
        columns = selection.observation.joint_columns
        joints = {} if columns is None else {
            joint_target(j): j for j in range(1, columns.shape[2] + 1)
        }  # fmt: skip
        for c, candidate in enumerate(space.candidates):
            joint = joints.get(candidate.target)
            if candidate.quantity and joint is not None:
                basis = basis_of(space.X[:, space.start[c] : space.start[c + 1]])
                share = float(np.sum((basis.T @ space.y) ** 2)) / total
                shares[joint] = max(shares.get(joint, 0.0), share)
    ranked = sorted(((j, min(max(s, 0.0), 1.0)) for j, s in shares.items()), key=lambda i: -i[1])
    depends = dependence(space, selection.nuisance_basis, (), selection.groups)
    return Where(tuple(ranked), axes, tuple(depends[:6]))


def first_session(moment: float, log: Log) -> str:
    """Return the name of the first session with rows after ``moment``, s of the joined clock."""
    session, after = session_of(log), log.times() > moment
    return log.session_names[int(session[after].min() if after.any() else session.max())]


def is_between_sessions(moment: float, log: Log) -> bool:
    """Return whether no session has rows before and after ``moment``, s of the joined clock."""
    session, after = session_of(log), log.times() > moment
    if after.all() or not after.any():
        return False
    return bool(session[~after].max() < session[after].min())


def on_own_clocks(channel: ChannelDiagnosis, log: Log) -> ChannelDiagnosis:
    """Return a channel's diagnosis whose moments are of the sessions' own clocks.

    Where these overlap, a moment has no value (nan), but the first session after it. Where the log
    has no times, it is a row's number, which has no unit.
    """
    if log.one_clock and log.has("timestamp"):
        return channel

    def own(moment: Reported) -> Reported:
        if log.one_clock:
            return replace(moment, unit="")
        session = first_session(moment.value, log)
        return replace(moment, value=float("nan"), std=None, session=session)

    def moments(parameters: Iterable[Reported]) -> tuple[Reported, ...]:
        return tuple(own(p) if p.is_time else p for p in parameters)

    def causes(some: Iterable[Cause]) -> tuple[Cause, ...]:
        return tuple(replace(cause, parameters=moments(cause.parameters)) for cause in some)

    def transfer(one: SessionTransfer) -> SessionTransfer:
        return replace(one, values=tuple((s, moments(p)) for s, p in one.values))

    return replace(
        channel, causes=causes(channel.causes), stand_ins=causes(channel.stand_ins),
        session_transfer=tuple(transfer(one) for one in channel.session_transfer),
    )  # fmt: skip


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
