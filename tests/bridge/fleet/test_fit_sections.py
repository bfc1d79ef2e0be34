"""Flexibilities and drifts of a fleet at zero: no share of what has no size is told."""

from __future__ import annotations

import numpy as np
import pytest

from gapbridge.bridge.document.blocks import Bar, Table
from gapbridge.bridge.fleet.drift import Drift
from gapbridge.bridge.fleet.fit_summary import FittedType, FleetFit
from gapbridge.bridge.fleet.report.fit_sections import types
from gapbridge.bridge.fleet.report.shared_sections import drifts
from gapbridge.core.estimation.hierarchical import Scatter

NAMES = ("axial_compliance_1", "axial_compliance_2", "radial_compliance_1", "radial_compliance_2")


def fitted_type(mean: list[float]) -> FittedType:
    """Return a type whose arms scatter by 0.1 urad/Nm about ``mean`` (4,), known to 1 urad/Nm."""
    scatter = Scatter(
        np.array(mean), np.diag([1e-12] * 4), np.full(4, 1e-7), np.full(4, 2e-7), 1e-5, 3, 12,
        np.array([True, True, True, False]),
    )  # fmt: skip
    return FittedType("ur10e", NAMES, scatter, ())


def test_a_scatter_about_zero_has_its_unit_and_others_are_shares() -> None:
    kind = fitted_type([1e-5, 0.0, 5e-7, 0.0])
    (table,) = (block for block in types(FleetFit((kind,), (), ())) if isinstance(block, Table))
    first, second, third, last = table.rows
    assert [cell.text for cell in first[2:] if isinstance(cell, Bar)] == ["1 %", "2 %"]
    assert second[1:] == ["0 ± 1.0 µrad/Nm", "0.10 µrad/Nm", "0.20 µrad/Nm"]
    assert third[2:] == second[2:]
    assert last[2:] == ["–", "–"]
    assert kind.spread == pytest.approx(0.01)
    assert fitted_type([0.0, 0.0, 5e-7, 0.0]).spread is None


def test_a_drift_from_zero_is_drawn_as_a_share_of_what_it_reaches() -> None:
    for value in ((0.0, 1e-6, 2e-6), (0.0, 0.0, 0.0)):
        found = Drift(
            "a", NAMES[0], "rad/Nm", "session", 1e-6, 1e-8, 1e-9, (0.0, 1.0, 2.0), value, ("s",) * 3
        )
        text = str(drifts([found]))
        assert ("text='100'" in text) is any(value)
        assert "e+" not in text
        assert "nan" not in text
