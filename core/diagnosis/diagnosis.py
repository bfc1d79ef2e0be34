"""The diagnosis of a log: where each channel's gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.arrays import Array
from gapbridge.core.diagnosis.across_sessions import carried
from gapbridge.core.diagnosis.causes import Cause, Considered, causes_of, considered_of
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict, Where, locate
from gapbridge.core.diagnosis.channels import position, torque, tracking, wrench
from gapbridge.core.diagnosis.channels.simulation import joined, predicted_by
from gapbridge.core.diagnosis.criteria import MIN_CONDITIONS, MIN_FREEDOM, UNRESOLVED
from gapbridge.core.diagnosis.every_row.gap_sizes import gaps, sizes_of, streamed_sizes
from gapbridge.core.diagnosis.every_row.long_recording import LongRecording, long_recording
from gapbridge.core.diagnosis.every_row.refitted import (
    on_every_row,
    refitted,
    still_accused,
    with_uncertain_terms,
)
from gapbridge.core.diagnosis.every_row.streamed import RowSums, Streamed
from gapbridge.core.diagnosis.finding import (
    ChannelFinding,
    Fact,
    Finding,
    NotAccused,
    Outliers,
    Slip,
    Thinned,
    TooFewRows,
)
from gapbridge.core.diagnosis.generalisation import generalisation
from gapbridge.core.diagnosis.held_out import HeldOut
from gapbridge.core.diagnosis.judgement import (
    Judgement,
    judge,
    judge_geometry,
    still_sure,
    with_stand_ins,
)
from gapbridge.core.diagnosis.log_checks.missing_flexibility import softness_findings
from gapbridge.core.diagnosis.log_checks.units_and_clocks import check_units, findings
from gapbridge.core.diagnosis.noise_floor import (
    Floor,
    noise_floor,
    whiteness,
)
from gapbridge.core.diagnosis.observation import NotObservable, Observation, thinned
from gapbridge.core.diagnosis.remainder import closes_gap
from gapbridge.core.diagnosis.residual_structure import dependence
from gapbridge.core.diagnosis.selection.moments import slips
from gapbridge.core.diagnosis.selection.rounds import select
from gapbridge.core.diagnosis.selection.selection import Selection, refitted_alone
from gapbridge.core.diagnosis.separation import Measurement, next_measurements
from gapbridge.core.effects import CATALOGUE, Term, correcting, flexibility_effects
from gapbridge.core.errors import LogError
from gapbridge.core.fitted_range import outside_findings
from gapbridge.core.log.columns import COLUMNS, did_you_mean
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Uncertain
from gapbridge.core.sessions import session_of, sessions_in, with_sessions

Depends = tuple[tuple[str, float], ...]  # quantity, share
Observe = Callable[[Model, Log, Metrology], Observation | NotObservable]

CHANNELS: Mapping[str, Observe] = {
    "position": position.observe,
    "wrench": wrench.observe,
    "tracking": tracking.observe,
    "torque": torque.observe,
}


# samples that a diagnosis looks at: more cost time and add hardly anything
MOST = {"position": 1200, "wrench": 300, "tracking": 300, "torque": 300}


@dataclass(frozen=True)
class Diagnosis:
    """What was found in a log."""

    verdict: Verdict
    channels: tuple[ChannelDiagnosis, ...]
    not_observable: tuple[NotObservable, ...]
    next_measurements: tuple[Measurement, ...]
    findings: tuple[Finding, ...]
    model: Model = field(repr=False)  # with the causes in it
    with_stand_ins: Model = field(repr=False)  # with the stand-ins too, fitted along
    sessions: tuple[str, ...] = ()  # names, where there are several
    one_clock: bool = True  # False: the sessions' timestamps overlap

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return the terms of all causes."""
        return tuple(t for c in self.channels for cause in c.causes for t in cause.terms)


def channels_of(uncertain: Uncertain | None) -> Mapping[str, Observe]:
    """Return the channels' observers, where ``uncertain`` says how unsure the model's poses are.

    By what its own fitted numbers leave open, those of further terms known: causes are as unsure.
    """
    if uncertain is None:
        return CHANNELS

    def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
        seen = position.observe(model, log, metrology)
        if isinstance(seen, NotObservable):
            return seen
        q, rows, k = log.require("actual_q", "target_q"), seen.rows, seen.measured.shape[1]
        loads = log.loads()[rows]
        return replace(seen, uncertain=lambda terms: uncertain(q[rows], loads, terms)[:, :k])

    return {**CHANNELS, "position": observe}


def diagnose(
    model: Model,
    log: Log,
    metrology: Metrology | None = None,
    *,
    withhold: Iterable[str] = (),
    progress: Callable[[str], None] | None = None,
    observers: Mapping[str, Observe] = CHANNELS,
    simulated: Log | None = None,
) -> Diagnosis:
    """Return the diagnosis of ``log`` against ``model``, in every channel that the log shows.

    ``withhold`` names effects to take out of the catalogue; ``simulated`` is the log of another
    simulator, row by row, whose values are the prediction instead of the model's. Raises LogError
    where the log cannot be used at all (units, numbers, no channel to look at).
    """
    # matrices of this size gain nothing from threads, which wait for each other on a busy machine
    with threadpool_limits(1, "blas"):
        metrology = metrology or Metrology()
        log = with_sessions(log, model)
        if metrology.remounted:  # what each session has of its own is no effect that they share
            withhold = (*withhold, *correcting("tool"))
        return _diagnose(model, log, metrology, tuple(withhold), progress, observers, simulated)


def _diagnose(
    model: Model, log: Log, metrology: Metrology, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None, observers: Mapping[str, Observe],
    simulated: Log | None,
) -> Diagnosis:  # fmt: skip
    check_units(model, log)
    notes: list[Finding] = [*_log_findings(model, log, metrology)]
    if simulated is not None:
        log = joined(log, simulated)
        observers = {name: predicted_by(name, o) for name, o in observers.items()}
    long = long_recording(log)
    channels: list[ChannelDiagnosis] = []
    streaming: list[tuple[_Searched, RowSums]] = []
    hidden: list[NotObservable] = []
    for name, observe in observers.items():
        sampled = None if name == "position" else long
        samples = _samples(observe, model, log, metrology, sampled)
        if isinstance(samples, NotObservable):
            hidden.append(samples)
        elif _too_few(samples[0]):
            notes.append(ChannelFinding(name, TooFewRows(len(samples[0].rows))))
            hidden.append(NotObservable(name, ("more rows",)))
        elif sampled is None:
            searched = _searched(*samples, model, withhold, progress)
            channels.append(_decided(searched, model, None))
        else:
            searched = _searched(*samples, model, withhold, progress).without_columns()
            streamed = partial(_observed_in, observe, model, metrology)
            streaming.append((searched, searched.row_sums(streamed, model)))
    if long is not None and streaming:
        if progress:
            progress(f"all {len(log)} rows")
        for block in long:
            for _, sums in streaming:
                sums.add(long, block)
        channels += [_decided(searched, model, sums.streamed()) for searched, sums in streaming]
    if not channels:
        raise _no_channel(log, hidden)
    notes += [
        ChannelFinding(c.channel, Thinned(MOST[c.channel], c.samples))
        for c in channels if c.samples > MOST[c.channel]
    ]  # fmt: skip
    soft = {*flexibility_effects().values()} - {*withhold}
    for channel in channels:
        notes += [ChannelFinding(channel.channel, fact) for fact in _facts(channel, log)]
        if simulated is None and len(soft) == 2 and _lacks_much(channel):
            notes += softness_findings(model, log, metrology)
    terms = _for_the_model(channels)
    if not log.one_clock:
        terms = [_slipped(term, log) for term in terms]
    return Diagnosis(
        _overall(channels), tuple(channels), tuple(hidden),
        next_measurements(model, log, channels), tuple(notes), model.with_terms(terms),
        model.with_terms(_and_stand_ins(channels, terms)),
        log.session_names, log.one_clock,
    )  # fmt: skip


def _samples(
    observe: Observe, model: Model, log: Log, metrology: Metrology, long: LongRecording | None
) -> tuple[Observation, Observation] | NotObservable:
    """Return the samples of a channel to search in, and all of them, by their rows in the log."""
    excerpt = log if long is None else long.excerpt
    whole = observe(model, excerpt, metrology)
    if isinstance(whole, NotObservable):
        return whole
    fewer = whole
    if len(whole.rows) > MOST[whole.channel]:
        fewer = _thinned(whole, model, excerpt, metrology, observe)
    if long is None:
        return fewer, whole
    return replace(fewer, rows=long.rows[fewer.rows]), replace(whole, rows=long.rows[whole.rows])


def _no_channel(log: Log, hidden: Sequence[NotObservable]) -> LogError:
    needs = "; ".join(f"{h.channel}: {', '.join(h.needs)}" for h in hidden)
    missing = [need for h in hidden for need in h.needs if need in COLUMNS]
    hint = did_you_mean(log.unknown, missing, log.n)
    return LogError(f"{log.path}: found no channel to diagnose, expected one of: {needs}{hint}")


def _observed_in(
    observe: Observe, model: Model, metrology: Metrology, log: Log
) -> Observation | NotObservable:
    return observe(model, log, metrology)


@dataclass(frozen=True)
class _Searched:
    """What a search in a channel's samples found, before more rows judge."""

    observation: Observation
    selection: Selection  # on all samples of the channel
    more: bool  # these are more than were searched
    judgement: Judgement
    # on what the rest depends in the samples that were searched, beside some of the terms
    depends: Callable[[Sequence[int]], Depends]
    where: Where
    considered: tuple[Considered, ...]
    stand_ins: tuple[Cause, ...]
    fitted_together: tuple[Term, ...]  # causes and stand-ins

    def without_columns(self) -> _Searched:
        """Return the same without the columns of all candidates: 50 MB that no row asks for."""
        known = self.judgement.depends_on or self.depends(self.judgement.accused)
        return replace(self, depends=lambda _: known)

    def row_sums(self, observe: Callable[[Log], Any], model: Model) -> RowSums:
        """Return the sums over all rows of a long recording, at what was found."""
        by_region = self.judgement.remainder is not None
        return RowSums(self.selection, self.judgement.accused, observe, model.arm, by_region)


def _log_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return what is suspicious about the log; of several sessions each by itself."""
    if len(log.session_names) < 2:
        return findings(log, model, metrology)
    sessions: dict[LogFinding, list[str]] = {}
    for name, part in zip(log.session_names, sessions_in(log), strict=True):
        session_model = position.session_model(model, part, metrology)
        for finding in findings(part, session_model, metrology):
            sessions.setdefault(finding, []).append(name)
    log_findings = [replace(finding, sessions=tuple(names)) for finding, names in sessions.items()]
    if not log.one_clock:
        log_findings.append(LogFinding(LogCheck.CLOCKS_OVERLAP))
    return log_findings + outside_findings(log)


def _thinned(
    observation: Observation, model: Model, log: Log, metrology: Metrology, observe: Observe
) -> Observation:
    """Return the channel with fewer samples; poses are looked at anew, so that frames stay free."""
    if observation.channel != "position":
        return thinned(observation, MOST[observation.channel])
    take = np.unique(np.linspace(0, len(observation.rows) - 1, MOST["position"]).astype(int))
    # last motions come from neighbouring rows: they are reported before rows are left out
    approach = log.approach()
    columns = dict(log.columns) | ({} if approach is None else {"approach": approach})
    part = observe(model, replace(log, columns=columns).select(observation.rows[take]), metrology)
    assert isinstance(part, Observation)
    return replace(part, rows=observation.rows[take])


def _for_the_model(channels: Sequence[ChannelDiagnosis]) -> list[Term]:
    """Return each cause once: what several channels show (a payload) by the most certain one."""
    best: dict[tuple[str, object], tuple[float, Term]] = {}
    for channel in channels:
        for cause in channel.causes:
            for term, deviation in zip(cause.terms, cause.relative_deviation, strict=True):
                key = (term.effect, term.site)
                if key not in best or deviation < best[key][0]:
                    best[key] = (deviation, term)
    return [term for _, term in best.values()]


def _and_stand_ins(channels: Sequence[ChannelDiagnosis], proved: Sequence[Term]) -> list[Term]:
    """Return the proved terms and the stand-ins, with the values that they have together."""
    terms = {(t.effect, t.site): t for t in proved}
    for channel in channels:
        terms |= {(t.effect, t.site): t for t in channel.fitted_together}
    return list(terms.values())


def _slipped(term: Term, log: Log) -> Term:
    """Return a term that steps once as it stands today: clocks that overlap hold no moment."""
    if not CATALOGUE[term.effect].at_moment:
        return term
    return replace(term, values=(*term.values[:-1], float(log.times()[0]) - 1.0))


def _lacks_much(channel: ChannelDiagnosis) -> bool:
    """Return whether poses leave a gap that no cause accounts for."""
    return channel.channel == "position" and channel.verdict in (
        Verdict.UNEXPLAINED,
        Verdict.PARTLY_EXPLAINED,
    )


def _too_few(observation: Observation) -> bool:
    """Return whether there are too few samples for a diagnosis."""
    N, k, p = observation.nuisance.shape
    return N * k < p + MIN_FREEDOM or len(np.unique(observation.groups)) < MIN_CONDITIONS


def _found(
    observation: Observation, model: Model, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None,
) -> tuple[Selection, Judgement, tuple[Considered, ...]]:  # fmt: skip
    """Return what a search found, what of it stays, and what fell before.

    Where nothing stays, what fell may have stood in the place of the causes. A second search goes
    without it, and counts where it closes the gap in every part of the log: of an iiwa under three
    loads one draw of the poses in two came to nothing else.
    """

    def judged(without: tuple[str, ...]) -> tuple[Selection, Judgement]:
        found = select(observation, model, without, progress)
        return judge_geometry(found, judge(found, HeldOut(found)), model.arm)

    first, judgement = judged(withhold)
    fallen = {first.terms[p].effect for p, _ in judgement.withdrawn}
    unexplained = judgement.structured and not judgement.accused
    if not (unexplained and fallen and observation.channel == "position"):
        return first, judgement, ()
    second, other = judged((*withhold, *fallen))
    if not closes_gap(second, [second.term_index[p] for p in other.accused]):
        return first, judgement, ()
    considered = considered_of(first, judgement, HeldOut(first), withhold)
    return second, other, tuple(c for c in considered if c.effect in fallen)


def _searched(
    observation: Observation, whole: Observation, model: Model, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None,
) -> _Searched:  # fmt: skip
    """Return what a search in ``observation`` found, refitted on all samples of ``whole``."""
    searched, judgement, fallen = _found(observation, model, withhold, progress)
    held = HeldOut(searched)
    judgement = with_stand_ins(searched, judgement)
    stand_ins = _stand_ins(searched, judgement, held, model)
    searched, judgement = still_sure(searched, judgement, model.arm)
    without = (*withhold, *(c.effect for c in fallen))
    considered = (*considered_of(searched, judgement, held, without), *fallen)
    chosen = [searched.term_index[p] for p in judgement.accused]
    where = locate(searched, gaps(searched, chosen)[0][searched.kept], chosen)
    selection = searched
    if len(whole.rows) > len(observation.rows):
        if progress:
            progress(f"{observation.channel}: all {len(whole.rows)} rows")
        judgement = with_uncertain_terms(judgement)
        selection = on_every_row(searched, judgement, whole, model)

    def follows(accused: Sequence[int]) -> Depends:
        fitted = [searched.term_index[p] for p in accused]
        basis = searched.nuisance_basis
        return tuple(dependence(searched.space, basis, fitted, searched.groups))

    more = selection is not searched
    return _Searched(
        observation, selection, more, judgement, follows, where, considered, *stand_ins
    )


def _decided(searched: _Searched, model: Model, streamed: Streamed | None) -> ChannelDiagnosis:
    """Return what all rows leave of what was found; ``streamed`` are those of a long recording."""
    observation, shown = searched.observation, searched.selection
    judgement = searched.judgement
    decided = shown if streamed is None else streamed.selection(judgement.accused)
    held = HeldOut(decided)
    if searched.more or streamed is not None:
        unknown = judgement.remainder is not None
        alone = partial(refitted, model, unknown) if streamed is None else streamed.alone
        decided, judgement = still_accused(decided, judgement, held, alone)
    if streamed is None:
        shown = decided
    else:
        shown = replace(shown, terms=decided.terms, covariance=decided.covariance)
    chosen = [decided.term_index[p] for p in judgement.accused]
    gap, remaining = gaps(shown, chosen)
    if streamed is None:
        sizes = sizes_of(shown, gap, remaining)
    else:
        sizes = streamed_sizes(streamed, decided, judgement.accused)
    causes = causes_of(decided, judgement, held, model.arm)
    judgement, floor = _with_whiteness(judgement, shown, sizes.means, searched.depends)
    held_rms = held.rms(chosen) if held.possible else None
    if not causes:  # nothing was fitted but the frame, before as well as after
        held_rms = sizes.gap_rms
    if sizes.remaining_rms < UNRESOLVED:
        judgement = replace(judgement, structured=False, depends_on=())
    structured = judgement.structured
    verdict = Verdict.EXPLAINED if causes else Verdict.NO_GAP
    if structured:
        verdict = Verdict.PARTLY_EXPLAINED if causes else Verdict.UNEXPLAINED
    per_sample = held if streamed is None else HeldOut(shown)
    return ChannelDiagnosis(
        channel=observation.channel, unit=observation.unit, samples=sizes.samples,
        gap_rms=sizes.gap_rms, gap_max=sizes.gap_max, noise_floor_rms=floor.rms,
        remaining_rms=sizes.remaining_rms, remaining_rms_held_out=held_rms,
        where=searched.where, causes=causes, considered=searched.considered,
        unexplained_rms=_unexplained(sizes.remaining_rms, floor.rms, judgement),
        structured=structured, p_value=judgement.p_value, depends_on=judgement.depends_on,
        verdict=verdict, selection=shown, judgement=judgement, gap=gap, remaining=remaining,
        held_out=np.sqrt(per_sample.squares(chosen)) if per_sample.possible else None,
        outliers=sizes.outliers, elsewhere=generalisation(decided, chosen),
        carried=carried(decided, chosen, model.arm),
        noise_floor_source=floor.source, stand_ins=searched.stand_ins,
        fitted_together=searched.fitted_together,
    )  # fmt: skip


def _with_whiteness(
    judgement: Judgement, selection: Selection, means: Array | None,
    depends: Callable[[Sequence[int]], Depends],
) -> tuple[Judgement, Floor]:  # fmt: skip
    """Return the judgement with what all rows of a recording say of its residual, and the floor."""
    floor = noise_floor(selection, judgement.structured)
    test = whiteness(means, floor.rms)
    if test is None or test.white:
        return judgement, floor
    p_value = test.p_value if judgement.p_value is None else min(judgement.p_value, test.p_value)
    judgement = replace(
        judgement,
        structured=True,
        p_value=p_value,
        depends_on=judgement.depends_on or depends(judgement.accused),
    )
    return judgement, noise_floor(selection, True)


def _stand_ins(
    selection: Selection, judgement: Judgement, held: HeldOut, model: Model
) -> tuple[tuple[Cause, ...], tuple[Term, ...]]:
    """Return the stand-ins as causes, and the terms of causes and stand-ins fitted together."""
    if not judgement.stand_ins:
        return (), ()
    both = (*judgement.accused, *judgement.stand_ins)
    together = refitted_alone(selection, model.arm, both)
    notes = replace(judgement, accused=both, ties={})
    marked = [replace(together.terms[p], stand_in=p in judgement.stand_ins) for p in both]
    return causes_of(together, notes, held, model.arm, judgement.stand_ins), tuple(marked)


def _unexplained(remaining: float, floor: float | None, judgement: Judgement) -> float:
    """Return the rms of what is left beyond the noise; of a residual without structure 0.

    Where no floor is known, or one no lower than what is left, what the residual depends on says
    its share; where nothing does either, no part of it is known to be noise.
    """
    if not judgement.structured:
        return 0.0
    beyond = float(np.sqrt(max(remaining**2 - floor**2, 0.0))) if floor is not None else 0.0
    if beyond > 0:
        return beyond
    share = max((share for _, share in judgement.depends_on), default=1.0)
    return remaining * float(np.sqrt(np.clip(share, 0.0, 1.0)))


def _overall(channels: Sequence[ChannelDiagnosis]) -> Verdict:
    verdicts = {c.verdict for c in channels}
    if verdicts == {Verdict.NO_GAP}:
        return Verdict.NO_GAP
    if verdicts <= {Verdict.NO_GAP, Verdict.EXPLAINED}:
        return Verdict.EXPLAINED
    if any(c.causes for c in channels):
        return Verdict.PARTLY_EXPLAINED
    return Verdict.UNEXPLAINED


def _line_of(log: Log, row: int) -> tuple[int, str]:
    """Return the line of a row in its file; of several sessions with the session's name."""
    name = log.session_names[int(session_of(log)[row])] if log.session_names else ""
    return log.line(row), name


def _facts(channel: ChannelDiagnosis, log: Log) -> list[Fact]:
    """Return what a channel's diagnosis has to report beside its figures."""
    facts: list[Fact] = []
    if len(channel.outliers):
        facts.append(Outliers(tuple(_line_of(log, int(row)) for row in channel.outliers)))
    selection, judgement = channel.selection, channel.judgement
    for position_, reason in judgement.withdrawn:
        stand_in = position_ in judgement.stand_ins
        facts.append(NotAccused(selection.terms[position_], reason, stand_in))
    terms = [term for cause in channel.causes for term in cause.terms]
    seen, alone = selection.observation, channel.verdict is Verdict.EXPLAINED
    timed = "timestamp" in seen.quantities
    for term, before, after in slips(terms, seen.times):
        facts.append(Slip(term, before, after, timed, alone))
    return facts + [note for cause in channel.causes for note in cause.notes]
