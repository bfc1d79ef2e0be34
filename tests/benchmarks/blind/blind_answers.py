"""Diagnoses made up for the tests of the scorer."""

from __future__ import annotations

from typing import Any

from benchmarks.blind.label import Label


def cause(effect: str, joints=(), parameters=(), ties=()) -> dict[str, Any]:
    """Return one accusation."""
    return {
        "effect": effect,
        "joints": list(joints),
        "parameters": [{"name": n, "value": v, "std": s, "unit": ""} for n, v, s in parameters],
        "indistinguishable_from": list(ties),
    }


def answer(label: Label, causes=(), structured=False, depends=(), held_out=None) -> dict[str, Any]:
    """Return a diagnosis of the label's channel."""
    return {
        "schema": "gapbridge.diagnosis/1",
        "channels": [
            {
                "channel": label.channel,
                "causes": list(causes),
                "remaining_rms_held_out": held_out or label.floor_rms,
                "unexplained": {
                    "structured": structured,
                    "depends_on": [{"quantity": q, "held_out_r2": 0.5} for q in depends],
                },
            }
        ],
    }


def true_causes(label: Label, off: float = 0.0) -> list[dict[str, Any]]:
    """Return the accusations of one who knows; values ``off`` standard deviations away."""
    return [
        cause(c.effect, c.joints, [(n, v + off * 1e-9, 1e-9) for n, v in c.parameters.items()])
        for c in label.causes
    ]
