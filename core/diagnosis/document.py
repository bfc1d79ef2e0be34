"""The diagnosis as the contract's JSON (schema ``gapbridge.diagnosis/1``)."""

from __future__ import annotations

import math
from typing import Any

from core.diagnosis.cause import Cause
from core.diagnosis.diagnosis import ChannelDiagnosis, Diagnosis

SCHEMA = "gapbridge.diagnosis/1"


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the diagnosis as JSON-ready values; a figure that cannot be had is None."""
    told: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict,
        "channels": [_channel(c) for c in diagnosis.channels],
        "not_observable": [
            {"channel": h.channel, "needs": list(h.needs)} for h in diagnosis.not_observable
        ],
        "next_measurements": [
            {
                "q": list(m.q),
                "payload": m.payload,
                "separates": list(m.separates),
                "expected_gain": m.expected_gain,
                **({"approach": list(m.approach)} if m.approach else {}),
                **({"velocity": list(m.velocity)} if m.velocity else {}),
                **({"acceleration": list(m.acceleration)} if m.acceleration else {}),
            }
            for m in diagnosis.next_measurements
        ],
        "findings": list(diagnosis.findings),
    }
    cleaned: dict[str, Any] = _finite(told)
    return cleaned


def _channel(c: ChannelDiagnosis) -> dict[str, Any]:
    frame = {"position": "base", "wrench": "flange"}.get(c.channel, "joints")
    return {
        "channel": c.channel,
        "unit": c.unit,
        "verdict": c.verdict,
        "samples": c.samples,
        "gap_rms": c.gap_rms,
        "gap_max": c.gap_max,
        "noise_floor_rms": c.noise_floor_rms,
        "remaining_rms": c.remaining_rms,
        "remaining_rms_held_out": c.remaining_rms_held_out,
        "where": {
            "joints": [{"joint": j, "share": s} for j, s in c.where.joints],
            "axes": {"frame": frame, "share": list(c.where.axes)},
            "depends_on": _quantities(c.where.depends_on),
        },
        "causes": [_cause(cause) for cause in c.causes],
        "stand_ins": [_cause(stand_in) for stand_in in c.stand_ins],
        "considered": [
            {
                "effect": k.effect,
                "shrink_alone": k.shrink_alone,
                "probability": k.probability,
                "excited": k.excited,
                "reason": k.reason,
            }
            for k in c.considered
        ],
        "unexplained": {
            "rms": c.unexplained_rms,
            "structured": c.structured,
            "p_value": c.p_value,
            "depends_on": _quantities(c.depends_on),
        },
    }


def _quantities(pairs: tuple[tuple[str, float], ...]) -> list[dict[str, Any]]:
    return [{"quantity": name, "held_out_r2": share} for name, share in pairs]


def _cause(cause: Cause) -> dict[str, Any]:
    shrink = cause.shrink
    return {
        "effect": cause.effect,
        "joints": list(cause.joints),
        "parameters": [
            {"name": p.name, "value": p.value, "std": p.std, "unit": p.unit}
            for p in cause.parameters
        ],
        "gap_without": shrink.gap_without if shrink else None,
        "gap_with": shrink.gap_with if shrink else None,
        "shrink": shrink.shrink if shrink else None,
        "shrink_interval": list(shrink.interval) if shrink else None,
        "shrink_alone": cause.shrink_alone,
        "probability": cause.probability,
        "indistinguishable_from": list(cause.indistinguishable_from),
    }


def _finite(value: Any) -> Any:
    """Return the value with what is no JSON number turned into None, bools and ints plain."""
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_finite(v) for v in value]
    if isinstance(value, bool) or value is None or isinstance(value, str | int):
        return value
    number = float(value)
    return number if math.isfinite(number) else None
