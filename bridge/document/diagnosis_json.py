"""The diagnosis as JSON (schema ``gapbridge.diagnosis/1``)."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from gapbridge.bridge.document.findings import considered_text, finding_text
from gapbridge.bridge.document.json_text import finite
from gapbridge.core.diagnosis.across_sessions import SessionTransfer
from gapbridge.core.diagnosis.causes import Cause
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.effects import Reported

SCHEMA = "gapbridge.diagnosis/1"


def document(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the diagnosis as JSON-ready values; a figure that is not available is None."""
    values: dict[str, Any] = {
        "schema": SCHEMA,
        "verdict": diagnosis.verdict.value,
        "channels": [_channel(c, diagnosis) for c in diagnosis.channels],
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
        "findings": [finding_text(f) for f in diagnosis.findings],
        "sessions": list(diagnosis.sessions),
    }
    cleaned: dict[str, Any] = finite(values)
    return cleaned


def _channel(c: ChannelDiagnosis, diagnosis: Diagnosis) -> dict[str, Any]:
    frame = {"position": "base", "wrench": "flange"}.get(c.channel, "joints")
    return {
        "channel": c.channel,
        "unit": c.unit,
        "verdict": c.verdict.value,
        "samples": c.samples,
        "gap_rms": c.gap_rms,
        "gap_max": c.gap_max,
        "noise_floor_rms": c.noise_floor_rms,
        "noise_floor_source": c.noise_floor_source,
        "remaining_rms": c.remaining_rms,
        "remaining_rms_held_out": c.remaining_rms_held_out,
        "remaining_rms_new_region": c.generalisation.new_region,
        "remaining_rms_new_session": c.generalisation.new_session,
        "sessions": [
            {"session": diagnosis.sessions[s], "remaining_rms_left_out": rms}
            for s, rms in c.generalisation.by_session
        ],
        "where": {
            "joints": [{"joint": j, "share": s} for j, s in c.where.joints],
            "axes": {"frame": frame, "share": list(c.where.axes)},
            "depends_on": _quantities(c.where.depends_on),
        },
        "causes": [_cause(cause, c, diagnosis) for cause in c.causes],
        "stand_ins": [_cause(stand_in, c, diagnosis) for stand_in in c.stand_ins],
        "considered": [
            {
                "effect": k.effect,
                "shrink_alone": k.shrink_alone,
                "probability": k.probability,
                "excited": k.excited,
                "reason": considered_text(k),
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


def _cause(cause: Cause, channel: ChannelDiagnosis, diagnosis: Diagnosis) -> dict[str, Any]:
    shrink = cause.shrink
    across = next((c for c in channel.session_transfer if c.effect == cause.effect), None)
    return {
        "effect": cause.effect,
        "joints": list(cause.joints),
        "parameters": parameter_entries(cause.parameters),
        "gap_without": shrink.gap_without if shrink else None,
        "gap_with": shrink.gap_with if shrink else None,
        "shrink": shrink.shrink if shrink else None,
        "shrink_interval": list(shrink.interval) if shrink else None,
        "shrink_alone": cause.shrink_alone,
        "probability": cause.probability,
        "indistinguishable_from": list(cause.indistinguishable_from),
        **({"across_sessions": _across(across, diagnosis.sessions)} if across else {}),
    }


def _across(transfer: SessionTransfer, sessions: tuple[str, ...]) -> dict[str, Any]:
    return {
        "carries": transfer.transfers,
        "p_value": transfer.p_value,
        "values": [
            {
                "session": sessions[s],
                "parameters": parameter_entries(parameters),
            }
            for s, parameters in transfer.values
        ],
    }


def parameter_entries(parameters: Iterable[Reported]) -> list[dict[str, Any]]:
    """Return name, value, standard deviation and unit of each parameter; unknown ones are None.

    Where the sessions' clocks overlap, a moment has no value, and the first session after it
    follows.
    """
    entries: list[dict[str, Any]] = []
    for p in parameters:
        entries.append(
            {"name": p.name, "value": finite(p.value), "std": finite(p.std), "unit": p.unit}
        )
        if p.session:
            name = session_parameter(p)
            entries.append({"name": name, "value": p.session, "std": None, "unit": ""})
    return entries


def session_parameter(moment: Reported) -> str:
    """Return the name under which the first session after a moment is listed."""
    return moment.name.removesuffix("_time") + "_session"
