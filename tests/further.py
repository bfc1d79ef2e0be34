"""Further cases of what a test shows: ``make everything`` runs them, ``make test`` does not."""

from __future__ import annotations

import pytest


def further(*cases: object) -> list[object]:
    """Return the cases of a ``parametrize`` marked as slow; a tuple holds several arguments."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]
