"""What a diagnosis found, as cells keep it: covariance, intervals, what was accused, with ties."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gapbridge.bridge.document.provenance import intervals_of
from gapbridge.core.calibration.spread import Spread
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.effects import flexibility_names
from gapbridge.core.estimation.identification import Identification


def spread_of(found: Diagnosis) -> Spread:
    """Return the covariance of the position channel's causes, each effect's numbers by itself."""
    for channel in found.channels:
        if channel.channel == "position":
            selection = channel.selection
            pairs = zip(selection.terms, selection.covariance, strict=True)
            causes = [(term, own) for term, own in pairs if term in found.terms]
            terms, covariance = [t for t, _ in causes], [own for _, own in causes]
            return Spread.of_terms(found.model, terms, covariance)
    return Spread.none()


def accused(found: Diagnosis, earlier: Sequence[Any] = ()) -> list[dict[str, Any]]:
    """Return the causes with values, standard deviations and ties, as the cell's provenance.

    ``earlier``: entries of the cell that was diagnosed, which are kept where nothing new is said.
    """
    entries: list[dict[str, Any]] = [
        {
            "effect": cause.effect, "joints": list(cause.joints), "channel": channel.channel,
            "parameters": [
                {"name": p.name, "value": float(p.value), "std": _known(p.std), "unit": p.unit}
                for p in cause.parameters
            ],
            "indistinguishable_from": list(cause.indistinguishable_from),
        }
        for channel in found.channels
        for cause in channel.causes
    ]  # fmt: skip
    new = {p["name"] for entry in entries for p in entry["parameters"]}
    kept = [one.model_dump() for one in earlier if not new & {p.name for p in one.parameters}]
    return [*entries, *kept]


def _known(std: float | None) -> float | None:
    return None if std is None or not math.isfinite(std) else float(std)


def intervals_applied(
    found: Diagnosis, *, stand_ins: bool = False
) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each number that ``--apply`` writes, by name."""
    applied = [
        cause
        for channel in found.channels
        for cause in (*channel.causes, *(channel.stand_ins if stand_ins else ()))
    ]
    return intervals_of((p.name, p.value, p.std) for cause in applied for p in cause.parameters)


def fit_intervals(found: Identification) -> dict[str, tuple[float, float]]:
    """Return the 95 % interval of each flexibility that a fit determines, by name, rad/Nm."""
    values = np.concatenate([found.axial, found.radial])
    stds = np.concatenate([found.std_axial, found.std_radial])
    numbers = zip(
        flexibility_names(len(values) // 2), values, stds, found.identifiable, strict=True
    )
    return intervals_of((name, float(v), float(std)) for name, v, std, shown in numbers if shown)
