"""The diagnosis of a log: where each channel's gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from core.diagnosis import position, torque, tracking, wrench
from core.diagnosis.cause import Cause, Considered, causes_of, considered_of
from core.diagnosis.held_out import HeldOut
from core.diagnosis.judgement import Judgement, judge, pure_error, with_stand_ins
from core.diagnosis.location import Where, locate
from core.diagnosis.observation import NotObservable, Observation, thinned
from core.diagnosis.rigid_suspicion import softness_findings
from core.diagnosis.selection import Selection, select, standing
from core.diagnosis.separation import Measurement, next_measurements
from core.diagnosis.simulation import joined, predicted_by
from core.diagnosis.suspicion import check_units, findings
from core.effects import Term
from core.errors import LogError
from core.log import Log
from core.log_columns import COLUMNS, misspelt
from core.metrology import Metrology
from core.model import Model

Array = NDArray[np.float64]
Observe = Callable[[Model, Log, Metrology], Observation | NotObservable]

CHANNELS: Mapping[str, Observe] = {
    "position": position.observe,
    "wrench": wrench.observe,
    "tracking": tracking.observe,
    "torque": torque.observe,
}


SOFTNESS = ("axial_compliance", "radial_compliance")
# samples that a diagnosis looks at: more cost time and tell hardly more
MOST = {"position": 1200, "wrench": 300, "tracking": 300, "torque": 300}


@dataclass(frozen=True)
class ChannelDiagnosis:
    """What was found in one channel; figures per coordinate, in the channel's unit."""

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
    verdict: str
    selection: Selection = field(repr=False)
    judgement: Judgement = field(repr=False)
    gap: Array = field(repr=False)  # (N, k) measured - predicted, frame fitted
    remaining: Array = field(repr=False)  # (N, k) with the causes in the model
    held_out: Array | None = field(repr=False)  # (kept,) rms of each held-out sample
    stand_ins: tuple[Cause, ...] = ()  # not proved, but useful where nothing was fitted
    along: tuple[Term, ...] = ()  # causes and stand-ins, fitted together


@dataclass(frozen=True)
class Diagnosis:
    """What was found in a log."""

    verdict: str
    channels: tuple[ChannelDiagnosis, ...]
    not_observable: tuple[NotObservable, ...]
    next_measurements: tuple[Measurement, ...]
    findings: tuple[str, ...]
    model: Model = field(repr=False)  # with the causes in it
    with_stand_ins: Model = field(repr=False)  # with the stand-ins too, fitted along

    @property
    def terms(self) -> tuple[Term, ...]:
        """Return the terms of all causes."""
        return tuple(t for c in self.channels for cause in c.causes for t in cause.terms)


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
        return _diagnose(model, log, metrology, tuple(withhold), progress, observers, simulated)


def _diagnose(
    model: Model, log: Log, metrology: Metrology, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None, observers: Mapping[str, Observe],
    simulated: Log | None,
) -> Diagnosis:  # fmt: skip
    check_units(model, log)
    told = findings(log, model, metrology)
    observed: list[ChannelDiagnosis] = []
    hidden: list[NotObservable] = []
    if simulated is not None:
        log = joined(log, simulated)
        observers = {name: predicted_by(name, o) for name, o in observers.items()}
    for observe in observers.values():
        seen = observe(model, log, metrology)
        if isinstance(seen, NotObservable):
            hidden.append(seen)
            continue
        if len(seen.rows) > MOST[seen.channel]:
            told.append(
                f"{seen.channel}: {MOST[seen.channel]} of {len(seen.rows)} rows were taken, evenly"
            )
            seen = _thinned(seen, model, log, metrology, observe)
        enough = _enough(seen)
        if enough is not None:
            told.append(enough)
            hidden.append(NotObservable(seen.channel, ("more rows",)))
            continue
        observed.append(_channel(seen, model, withhold, progress))
    if not observed:
        needs = "; ".join(f"{h.channel}: {', '.join(h.needs)}" for h in hidden)
        lacking = [need for h in hidden for need in h.needs if need in COLUMNS]
        hint = misspelt(log.unknown, lacking, log.n)
        raise LogError(f"{log.path}: found no channel to diagnose, expected one of: {needs}{hint}")
    for channel in observed:
        told += _channel_findings(channel)
        if simulated is None and not {*withhold} & {*SOFTNESS} and _lacks_much(channel):
            told += softness_findings(model, log, metrology)
    terms = _for_the_model(observed)
    return Diagnosis(
        _overall(observed), tuple(observed), tuple(hidden),
        next_measurements(model, log, observed), tuple(told), with_found(model, terms),
        with_found(model, _for_the_model([_stood(c) for c in observed])),
    )  # fmt: skip


def _thinned(
    seen: Observation, model: Model, log: Log, metrology: Metrology, observe: Observe
) -> Observation:
    """Return the channel with fewer samples; poses are looked at anew, so that frames stay free."""
    if seen.channel != "position":
        return thinned(seen, MOST[seen.channel])
    take = np.unique(np.linspace(0, len(seen.rows) - 1, MOST["position"]).astype(int))
    # last motions come from neighbouring rows: they are told before rows are left out
    approach = log.approach()
    columns = dict(log.columns) | ({} if approach is None else {"approach": approach})
    part = observe(model, replace(log, columns=columns).select(seen.rows[take]), metrology)
    assert isinstance(part, Observation)
    return replace(part, rows=seen.rows[take])


def with_found(model: Model, terms: Sequence[Term]) -> Model:
    """Return the model with found terms added."""
    return model.with_terms(terms)


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


def _stood(channel: ChannelDiagnosis) -> ChannelDiagnosis:
    """Return the channel with its stand-ins as causes, marked."""
    if not channel.stand_ins:
        return channel
    fitted = {(t.effect, t.site): t for t in channel.along}
    causes = [
        replace(c, terms=tuple(
            replace(fitted[t.effect, t.site], stand_in=c in channel.stand_ins) for t in c.terms))
        for c in (*channel.causes, *channel.stand_ins)
    ]  # fmt: skip
    return replace(channel, causes=tuple(causes))


def _lacks_much(channel: ChannelDiagnosis) -> bool:
    """Return whether poses leave a gap that no cause accounts for."""
    return channel.channel == "position" and channel.verdict in ("unexplained", "partly_explained")


def _enough(seen: Observation) -> str | None:
    """Return why there are too few samples, or None."""
    N, k, p = seen.nuisance.shape
    if N * k < p + 6 or len(np.unique(seen.groups)) < 4:
        return f"{seen.channel}: {N} usable row(s) are too few for a diagnosis"
    return None


def _channel(
    seen: Observation, model: Model, withhold: tuple[str, ...],
    progress: Callable[[str], None] | None,
) -> ChannelDiagnosis:  # fmt: skip
    selection = select(seen, model, withhold, progress)
    held = HeldOut(selection)
    verdict = with_stand_ins(selection, judge(selection, held))
    stood_in = _stood_in(selection, verdict, held, model)
    selection = standing(selection, model.arm, verdict.accused, verdict.beside)
    chosen = [selection.term_index[p] for p in verdict.accused]
    gap, remaining = gaps(selection, chosen)
    k = 3 if seen.channel in ("position", "wrench") else gap.shape[1]
    kept = selection.kept
    causes = causes_of(selection, verdict, held, model.arm)
    left = float(np.sqrt(np.mean(remaining[kept][:, :k] ** 2)))
    held_rms = held.rms(chosen) if held.possible else None
    structured = verdict.structured
    floor = noise_floor(selection, structured)
    some_gap = bool(causes) or structured
    word = "no_gap" if not some_gap else "explained"
    if structured:
        word = "partly_explained" if causes else "unexplained"
    return ChannelDiagnosis(
        channel=seen.channel, unit=seen.unit, samples=len(gap),
        gap_rms=float(np.sqrt(np.mean(gap[kept][:, :k] ** 2))),
        gap_max=float(np.linalg.norm(gap[kept][:, :k], axis=1).max()),
        noise_floor_rms=floor, remaining_rms=left, remaining_rms_held_out=held_rms,
        where=locate(selection, gap[kept], chosen), causes=causes,
        considered=considered_of(selection, verdict, held, model.arm, withhold),
        unexplained_rms=_beyond(left, floor, structured), structured=structured,
        p_value=verdict.p_value, depends_on=verdict.depends_on, verdict=word,
        selection=selection, judgement=verdict, gap=gap, remaining=remaining,
        held_out=np.sqrt(held.squares(chosen)) if held.possible else None,
        **stood_in,
    )  # fmt: skip


def _stood_in(
    selection: Selection, verdict: Judgement, held: HeldOut, model: Model
) -> dict[str, Any]:
    """Return the stand-ins as causes, and the terms of causes and stand-ins fitted together."""
    if not verdict.stand_ins:
        return {}
    both = (*verdict.accused, *verdict.stand_ins)
    along = standing(selection, model.arm, both)
    told = causes_of(along, replace(verdict, accused=both, ties={}), held, model.arm)
    own = {along.terms[p] for p in verdict.stand_ins}
    shown = [replace(c, terms=tuple(t for t in c.terms if t in own)) for c in told]
    return {
        "stand_ins": tuple(c for c in shown if c.terms),
        "along": tuple(along.terms[p] for p in both),
    }


def gaps(selection: Selection, chosen: Sequence[int]) -> tuple[Array, Array]:
    """Return the gap (N, k) without and with the chosen terms, the nuisance fitted each time."""
    observation = selection.observation
    at = dict(zip(selection.term_index, selection.terms, strict=True))
    found = []
    for terms in ([], [at[c] for c in chosen]):
        gap = observation.measured - observation.predict(terms)
        if observation.nuisance.shape[2]:
            W = selection.noise.whitener
            kept = selection.kept
            A = (W @ observation.nuisance)[kept].reshape(-1, observation.nuisance.shape[2])
            b = (W @ gap[..., None])[kept].ravel()
            gap = gap - observation.nuisance @ np.linalg.lstsq(A, b, rcond=1e-12)[0]
        found.append(gap)
    return found[0], found[1]


def noise_floor(selection: Selection, structured: bool) -> float | None:
    """Return 1 sigma of one coordinate: instrument and repeatability, as stated or estimated."""
    observation = selection.observation
    if observation.sigma_is_whole:
        return observation.sigma
    k = 3 if observation.channel in ("position", "wrench") else observation.measured.shape[1]
    left = selection.residual[selection.kept][:, :k]
    pure, freedom = pure_error(left, observation.groups[selection.kept])
    if structured and freedom >= 30:
        return float(np.sqrt(max(pure, observation.sigma**2)))
    covariance = np.linalg.inv(selection.noise.whitener)
    variance = np.einsum("nij,nij->ni", covariance, covariance)[:, :k]
    return float(np.sqrt(np.mean(variance)))


def _beyond(left: float, floor: float | None, structured: bool) -> float:
    if not structured or floor is None:
        return 0.0
    return float(np.sqrt(max(left**2 - floor**2, 0.0)))


def _overall(channels: Sequence[ChannelDiagnosis]) -> str:
    words = {c.verdict for c in channels}
    if words == {"no_gap"}:
        return "no_gap"
    if words <= {"no_gap", "explained"}:
        return "explained"
    if any(c.causes for c in channels):
        return "partly_explained"
    return "unexplained"


def _channel_findings(channel: ChannelDiagnosis) -> list[str]:
    told = []
    wild = channel.selection.observation.rows[~channel.selection.kept]
    if len(wild):
        rows = ", ".join(str(int(r) + 2) for r in wild[:8])
        told.append(
            f"{channel.channel}: {len(wild)} wild reading(s) set aside (row {rows}"
            f"{', ...' if len(wild) > 8 else ''} of the file)"
        )
    for position_, reason in channel.judgement.withdrawn:
        term = channel.selection.terms[position_]
        joint = f" of joint {term.site.joint}" if term.site.joint else ""
        told.append(f"{channel.channel}: {term.effect}{joint} is not accused: {reason}")
        if position_ in channel.judgement.stand_ins:
            told[-1] += "; poses not fitted gain by it: a stand-in"
    for cause in channel.causes:
        told += [f"{channel.channel}: {note}" for note in cause.notes]
    return told
