"""The table of fitted parameters at a width of 80 columns."""

from __future__ import annotations

import io
from types import SimpleNamespace

from rich.console import Console

from gapbridge.bridge.calibration.jobs.calibrate import _table


def estimate(name: str, unit: str, *, shown: bool, on_bound: bool) -> SimpleNamespace:
    return SimpleNamespace(
        name=name, value=8.8e-6, std=1.2e-6, unit=unit, shown=shown, on_bound=on_bound,
        expected_std=16.1e-6,
    )  # fmt: skip


def test_nothing_is_cut_off_at_eighty_columns() -> None:
    rows = [
        estimate("link_geometry_1_alpha", "rad", shown=True, on_bound=False),
        estimate("radial_compliance_5", "rad/Nm", shown=False, on_bound=True),
    ]
    out = io.StringIO()
    Console(file=out, width=80).print(_table(SimpleNamespace(estimates=rows)))
    text = out.getvalue()
    assert "…" not in text
    assert all(word in text for word in ("link_geometry_1_alpha", "identifiable", "(bound)"))
