"""The covariance of what a diagnosis found, as cells keep it."""

from __future__ import annotations

from gapbridge.core.calibration.spread import Spread
from gapbridge.core.diagnosis.diagnosis import Diagnosis


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
