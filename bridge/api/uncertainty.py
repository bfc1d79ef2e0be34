"""Uncertainty of a fit or diagnosis as cells keep it: covariance, intervals, causes with ties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gapbridge.bridge.cell import Cell
from gapbridge.bridge.document.diagnosis_json import parameter_entries
from gapbridge.bridge.document.provenance import fitted, intervals_of
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.diagnosis.channel_diagnosis import (
    model_terms,
    terms_with_stand_ins,
    with_causes,
)
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.effects import CATALOGUE, flexibility_names
from gapbridge.core.estimation.identification import Identification
from gapbridge.core.log.log import Log
from gapbridge.core.log.log_finding import LogFinding
from gapbridge.core.model import Model
from gapbridge.core.sessions import with_sessions


def without_misread(diagnosis: Diagnosis, model: Model, log: Log) -> Diagnosis:
    """Return a diagnosis without the causes of channels whose readings mean something else."""
    misread = {f.misread for f in diagnosis.findings if isinstance(f, LogFinding)}
    if not misread & {channel.channel for channel in diagnosis.channels}:
        return diagnosis
    channels = tuple(
        replace(c, causes=(), stand_ins=()) if c.channel in misread else c
        for c in diagnosis.channels
    )
    log = with_sessions(log, model)
    return replace(
        diagnosis, channels=channels, model=with_causes(model, model_terms(channels, log)),
        with_stand_ins=with_causes(model, terms_with_stand_ins(channels, log)),
    )  # fmt: skip


def spread_of(diagnosis: Diagnosis) -> Spread:
    """Return the covariance of the position channel's causes, block by block per effect."""
    for channel in diagnosis.channels:
        if channel.channel == "position":
            selection = channel.selection
            pairs = zip(selection.terms, selection.covariance, strict=True)
            causes = [(term, block) for term, block in pairs if term in diagnosis.terms]
            terms, covariance = [t for t, _ in causes], [block for _, block in causes]
            return Spread.of_terms(diagnosis.model, terms, covariance)
    return Spread.none()


def cause_entries(diagnosis: Diagnosis, earlier: Sequence[Any] = ()) -> list[dict[str, Any]]:
    """Return the causes with values, standard deviations and ties, as the cell's provenance.

    ``earlier``: the diagnosed cell's entries; those without a parameter of a new cause are kept.
    """
    entries: list[dict[str, Any]] = [
        {
            "effect": cause.effect, "joints": list(cause.joints), "channel": channel.channel,
            "parameters": parameter_entries(cause.parameters),
            "indistinguishable_from": list(cause.indistinguishable_from),
        }
        for channel in diagnosis.channels
        for cause in channel.causes
    ]  # fmt: skip
    new = {p["name"] for entry in entries for p in entry["parameters"]}
    kept = [old.model_dump() for old in earlier if not new & {p.name for p in old.parameters}]
    return [*entries, *kept]


def intervals_applied(
    diagnosis: Diagnosis, *, stand_ins: bool = False
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each number that ``--apply`` writes, by name.

    Of what adds up that is the total with what the cell held; 0 if it is gone.
    """
    model = diagnosis.with_stand_ins if stand_ins else diagnosis.model
    written: dict[str, float] = {}
    for term in model.terms:
        for number in CATALOGUE[term.effect].reported(model.arm, term, None):
            written[number.name] = written.get(number.name, 0.0) + number.value
    applied = [
        cause
        for channel in diagnosis.channels
        for cause in (*channel.causes, *(channel.stand_ins if stand_ins else ()))
    ]
    numbers = (
        (p.name, written.get(p.name, 0.0) if _adds_up(cause.effect) else p.value, p.std)
        for cause in applied
        for p in cause.parameters
    )
    return intervals_of(number for number in numbers if np.isfinite(number[1]))


def _adds_up(effect: str) -> bool:
    return CATALOGUE[effect].adds_up or bool(CATALOGUE[effect].flexibility)


def provenance_of_fit(
    cell: Cell, fit: Identification, origin: dict[str, Any],
    ranges: Mapping[str, tuple[float, float]],
) -> dict[str, Any]:  # fmt: skip
    """Return ``origin`` with what a cell keeps of its fit; ``ranges``: of each fitted quantity."""
    spread = Spread.of_fit(fit.identifiable, fit.covariance).beside(cell.spread)
    return fitted(origin, ranges, spread, cell.intervals | _intervals(fit))


def _intervals(fit: Identification) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each flexibility that a fit determines, by name, rad/Nm."""
    values = np.concatenate([fit.axial, fit.radial])
    stds = np.concatenate([fit.std_axial, fit.std_radial])
    numbers = zip(flexibility_names(len(values) // 2), values, stds, fit.identifiable, strict=True)
    return intervals_of((name, float(v), float(std)) for name, v, std, known in numbers if known)
