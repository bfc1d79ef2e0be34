"""The diagnosis of a log: where each channel's gap lies, its causes, how much they reduce it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from gapbridge.core.diagnosis.all_rows.long_recording import LongRecording, long_recording
from gapbridge.core.diagnosis.all_rows.row_sums import RowSums
from gapbridge.core.diagnosis.channel_diagnosis import (
    ChannelDiagnosis,
    Verdict,
    first_session,
    is_between_sessions,
    model_terms,
    on_own_clocks,
    terms_with_stand_ins,
    with_causes,
)
from gapbridge.core.diagnosis.channel_search import (
    SearchResult,
    search_and_refit,
    validated_diagnosis,
)
from gapbridge.core.diagnosis.channels import position, torque, tracking, wrench
from gapbridge.core.diagnosis.channels.simulation import joined, predicted_by
from gapbridge.core.diagnosis.criteria import (
    MAX_ARM_ERROR,
    MIN_CONDITIONS,
    MIN_FREEDOM,
)
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
from gapbridge.core.diagnosis.log_checks.missing_flexibility import flexibility_findings
from gapbridge.core.diagnosis.log_checks.units_and_clocks import check_units, findings
from gapbridge.core.diagnosis.observation import NotObservable, Observation
from gapbridge.core.diagnosis.selection.step_times import slips
from gapbridge.core.diagnosis.separation import Measurement, next_measurements
from gapbridge.core.diagnosis.thinning import thinned, thinned_poses
from gapbridge.core.effects import Term, correcting, flexibility_effects
from gapbridge.core.errors import LogError
from gapbridge.core.fitted_range import outside_findings
from gapbridge.core.log.columns import COLUMNS, did_you_mean
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogCheck, LogFinding
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model, Uncertain
from gapbridge.core.motion import without_turns, without_wrong_speeds
from gapbridge.core.sessions import session_of, sessions_in, with_sessions

Observe = Callable[[Model, Log, Metrology], Observation | NotObservable]

CHANNELS: Mapping[str, Observe] = {
    "position": position.observe,
    "wrench": wrench.observe,
    "tracking": tracking.observe,
    "torque": torque.observe,
}


# samples that are searched: more cost time and hardly change the result
MAX_SAMPLES = {"position": 1200, "wrench": 300, "tracking": 300, "torque": 300}


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of a log, in all channels."""

    verdict: Verdict
    channels: tuple[ChannelDiagnosis, ...]
    not_observable: tuple[NotObservable, ...]
    next_measurements: tuple[Measurement, ...]
    findings: tuple[Finding, ...]
    model: Model = field(repr=False)  # with the causes in it
    with_stand_ins: Model = field(repr=False)  # with causes and stand-ins, fitted together
    sessions: tuple[str, ...] = ()  # names, where there are several

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return the terms of all causes."""
        return tuple(t for c in self.channels for cause in c.causes for t in cause.terms)


def channels_of(uncertain: Uncertain | None) -> Mapping[str, Observe]:
    """Return the channels' observers, with the model's own pose uncertainty where it has one.

    ``uncertain`` gives the 1-sigma changes of a pose by the cell's fitted parameters; they widen
    the covariances of the causes.
    """
    if uncertain is None:
        return CHANNELS

    def observe(model: Model, log: Log, metrology: Metrology) -> Observation | NotObservable:
        observation = position.observe(model, log, metrology)
        if isinstance(observation, NotObservable):
            return observation
        rows, k = observation.rows, observation.measured.shape[1]
        q, loads = log.require("actual_q", "target_q"), log.loads()[rows]
        return replace(observation, uncertain=lambda terms: uncertain(q[rows], loads, terms)[:, :k])

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
    if the log cannot be used at all (units, numbers, no channel to diagnose).
    """
    # matrices of this size gain nothing from threads
    with threadpool_limits(1, "blas"):
        metrology = metrology or Metrology()
        log = without_wrong_speeds(without_turns(with_sessions(log, model)))
        if metrology.remounted:  # each session has a tool point of its own
            withhold = (*withhold, *correcting("tool"))
        return _diagnose(model, log, metrology, tuple(withhold), progress, observers, simulated)


def _diagnose(
    model: Model, log: Log, metrology: Metrology, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None, observers: Mapping[str, Observe],
    simulated: Log | None,
) -> Diagnosis:  # fmt: skip
    check_units(model, log)
    reported: list[Finding] = [*_log_findings(model, log, metrology)]
    if simulated is not None:
        log = joined(log, simulated)
        observers = {name: predicted_by(name, o) for name, o in observers.items()}
    long = long_recording(log)
    channels: list[ChannelDiagnosis] = []
    streaming: list[tuple[SearchResult, RowSums]] = []
    not_observable: list[NotObservable] = []
    for name, observe in observers.items():
        sampled = None if name == "position" else long
        samples = _samples(observe, model, log, metrology, sampled)
        if isinstance(samples, NotObservable):
            not_observable.append(samples)
        elif needed := _missing_samples(samples[0]):
            reported.append(ChannelFinding(name, TooFewRows(len(samples[0].rows))))
            not_observable.append(NotObservable(name, (needed,)))
        elif sampled is None:
            searched = search_and_refit(*samples, model, withhold, progress)
            channels.append(validated_diagnosis(searched, model, None))
        else:
            searched = search_and_refit(*samples, model, withhold, progress, True)
            searched = searched.without_columns()
            streamed = partial(_observed_in, observe, model, metrology)
            streaming.append((searched, searched.row_sums(streamed, model)))
    if long is not None and streaming:
        if progress:
            progress(f"all {len(log)} rows")
        for block in long:
            for _, sums in streaming:
                sums.add(long, block)
        channels += [
            validated_diagnosis(searched, model, sums.streamed()) for searched, sums in streaming
        ]
    if not channels:
        raise _no_channel(log, not_observable)
    reported += [
        ChannelFinding(c.channel, Thinned(MAX_SAMPLES[c.channel], c.samples))
        for c in channels if c.samples > MAX_SAMPLES[c.channel]
    ]  # fmt: skip
    flexibilities = {*flexibility_effects().values()} - {*withhold}
    for channel in channels:
        reported += [ChannelFinding(channel.channel, fact) for fact in _facts(channel, log)]
        if simulated is None and len(flexibilities) == 2 and _gap_unexplained(channel):
            reported += flexibility_findings(model, log, metrology)
    return Diagnosis(
        _overall(channels), tuple(on_own_clocks(channel, log) for channel in channels),
        tuple(not_observable), next_measurements(model, log, channels), tuple(reported),
        with_causes(model, model_terms(channels, log)),
        with_causes(model, terms_with_stand_ins(channels, log)),
        log.session_names,
    )  # fmt: skip


def _samples(
    observe: Observe, model: Model, log: Log, metrology: Metrology, long: LongRecording | None
) -> tuple[Observation, Observation] | NotObservable:
    """Return a channel's samples to search in, and all of them, with their rows in the log."""
    excerpt = log if long is None else long.excerpt
    whole = observe(model, excerpt, metrology)
    if isinstance(whole, NotObservable):
        return whole
    fewer = whole
    most = MAX_SAMPLES[whole.channel]
    if len(whole.rows) > most and whole.channel == "position":
        observed = partial(_observed_in, observe, model, metrology)
        fewer = thinned_poses(whole, excerpt, observed, most)
    elif len(whole.rows) > most:
        fewer = thinned(whole, most)
    if long is None:
        return fewer, whole
    return replace(fewer, rows=long.rows[fewer.rows]), replace(whole, rows=long.rows[whole.rows])


def _no_channel(log: Log, not_observable: Sequence[NotObservable]) -> LogError:
    needs = "; ".join(f"{h.channel}: {', '.join(h.needs)}" for h in not_observable)
    missing = [need for h in not_observable for need in h.needs if need in COLUMNS]
    hint = did_you_mean(log.unknown, missing, log.n)
    return LogError(f"{log.path}: found no channel to diagnose, expected one of: {needs}{hint}")


def _observed_in(
    observe: Observe, model: Model, metrology: Metrology, log: Log
) -> Observation | NotObservable:
    return observe(model, log, metrology)


def _log_findings(model: Model, log: Log, metrology: Metrology) -> list[LogFinding]:
    """Return the findings of the log checks, made for each session by itself."""
    if len(log.session_names) < 2:
        return findings(log, model, metrology)
    sessions: dict[LogFinding, list[str]] = {}
    for name, part in zip(log.session_names, sessions_in(log), strict=True):
        session_model = position.session_model(model, part, metrology)
        for finding in findings(part, session_model, metrology):
            sessions.setdefault(finding, []).append(name)
    log_findings = [replace(finding, sessions=tuple(names)) for finding, names in sessions.items()]
    turned: dict[str, Any] = {
        name: finding.values[0] for finding in log_findings for name in finding.sessions
        if finding.check is LogCheck.TARGET_AXES
    }  # fmt: skip
    angles = [turned.get(name, 0.0) for name in log.session_names]
    if np.ptp(angles) > MAX_ARM_ERROR and not metrology.remounted:
        log_findings.append(LogFinding(LogCheck.TARGET_REMOUNTED))
    if log.has("timestamp") and not log.one_clock:
        log_findings.append(LogFinding(LogCheck.CLOCKS_OVERLAP))
    return log_findings + outside_findings(log)


def _gap_unexplained(channel: ChannelDiagnosis) -> bool:
    """Return whether a gap of poses is not fully explained."""
    return channel.channel == "position" and channel.verdict in (
        Verdict.UNEXPLAINED,
        Verdict.PARTLY_EXPLAINED,
    )


def _missing_samples(observation: Observation) -> str:
    """Return which samples a diagnosis needs beyond these; empty if they are enough."""
    N, k, p = observation.nuisance.shape
    least, groups = max(-(-(p + MIN_FREEDOM) // k), MIN_CONDITIONS), len(set(observation.groups))
    if least > N:
        return f"at least {least} rows (found {N})"
    what = "poses" if observation.channel == "position" else "stretches of a recording"
    return "" if groups >= MIN_CONDITIONS else (
        f"at least {MIN_CONDITIONS} different {what} (found {groups} in {N} rows)"
    )  # fmt: skip


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
    """Return the line of a row in its file, and the session's name if there are several."""
    name = log.session_names[int(session_of(log)[row])] if log.session_names else ""
    return log.line(row), name


def _facts(channel: ChannelDiagnosis, log: Log) -> list[Fact]:
    """Return the facts to report about a channel in addition to its figures."""
    facts: list[Fact] = []
    if len(channel.outliers):
        facts.append(Outliers(tuple(_line_of(log, int(row)) for row in channel.outliers)))
    selection, judgement = channel.selection, channel.judgement
    for position_, reason in judgement.withdrawn:
        stand_in = position_ in judgement.stand_ins
        facts.append(NotAccused(selection.terms[position_], reason, stand_in))
    terms = [term for cause in channel.causes for term in cause.terms]
    facts += _slips(channel, terms, log)
    return facts + [note for cause in channel.causes for note in cause.notes]


def _slips(channel: ChannelDiagnosis, terms: Sequence[Term], log: Log) -> list[Slip]:
    """Return the slips among the terms of the causes."""
    observation, times = channel.selection.observation, log.times()
    found = slips(terms, observation.times)
    carried = all(transfer.transfers for transfer in channel.session_transfer)
    return [
        Slip(
            term, before, after, float(times[0]), float(times[-1]),
            timed="timestamp" in observation.quantities,
            alone=channel.verdict is Verdict.EXPLAINED and carried,
            session="" if log.one_clock else first_session(term.values[-1], log),
            others=len(found) - 1,
            between_sessions=is_between_sessions(term.values[-1], log),
        )
        for term, before, after in found
    ]  # fmt: skip
