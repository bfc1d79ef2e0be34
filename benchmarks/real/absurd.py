"""Accusations that no engineer believes, whatever they gain."""

from __future__ import annotations

from typing import Any

# the largest size that an arm in service has, by how a parameter's name ends or its effect begins
LARGEST = (
    ("link_geometry", ("_a", "_d"), 0.02), ("link_geometry", ("_alpha", "_beta"), 0.02),
    ("joint_offset", ("",), 0.1), ("joint_slip", ("",), 0.1),
    ("tool_frame", ("_x", "_y", "_z"), 0.05), ("tool_frame", ("_rx", "_ry", "_rz"), 0.1),
    ("target_slip", ("_x", "_y", "_z"), 0.05), ("backlash", ("",), 0.01),
    ("transmission_error", ("_amplitude",), 0.01), ("gravity_direction", ("",), 0.1),
    ("axial_compliance", ("",), 1e-3), ("radial_compliance", ("",), 1e-3),
    ("base_compliance", ("",), 1e-3), ("thermal_drift", ("",), 5e-5),
    ("latency", ("",), 0.3), ("tracking_lag", ("",), 0.5), ("ft_gain", ("",), 0.5),
    ("ft_misalignment", ("",), 0.6), ("torque_constant", ("",), 0.8),
    ("link_inertia", ("",), 1.0), ("load_friction", ("",), 1.0), ("payload_cog", ("",), 0.5),
)  # fmt: skip
POSITIVE = (
    "axial_compliance", "radial_compliance", "base_compliance", "link_flexibility",
    "stiffness_nonlinearity", "latency", "tracking_lag", "coulomb_friction", "viscous_friction",
    "stribeck_friction", "load_friction", "rotor_inertia", "servo_droop", "dead_band",
)  # fmt: skip
PLACES = ("_time", "_order", "_phase", "_velocity", "_session")


def absurdities(causes: list[dict[str, Any]], least: float, largest: float) -> list[str]:
    """Return what is absurd in the accusations of a channel, one short text each.

    ``least`` and ``largest`` are the payloads (kg) that the log declares.
    """
    out = []
    for cause in causes:
        effect, strong = str(cause["effect"]), False
        for parameter in cause.get("parameters") or []:
            name, value = str(parameter["name"]), parameter.get("value")
            if value is None or name.endswith(PLACES):
                continue
            std = parameter.get("std")
            strong = strong or not std or abs(value) > 3 * std
            why = _why(effect, name, float(value), least, largest)
            if why:
                out.append(f"{name} = {value:.3g} ({why})")
        if cause.get("parameters") and not (strong or _as_a_whole(cause)):
            out.append(f"{effect} (no number of it over 3 sigma)")
    return out


def _as_a_whole(cause: dict[str, Any]) -> bool:
    """Return whether all links are accused together, by what they gain on rows not fitted.

    No number of one has to stand out then: without them a Rokae is left at five times the error.
    """
    gain = cause.get("shrink_interval") or [0.0]
    return cause["effect"] == "link_geometry" and len(cause.get("joints", ())) > 1 and gain[0] > 0


def _why(effect: str, name: str, value: float, least: float, largest: float) -> str | None:
    if effect == "payload":
        if least + value < 0:
            return "a negative mass"
        if value > max(3 * largest, 30.0):
            return "heavier than the arm carries"
    if effect in POSITIVE and value < 0 and not name.endswith(("_x", "_y", "_z")):
        return "negative"
    if effect == "link_inertia" and value < -1:
        return "a negative mass"
    for known, ends, most in LARGEST:
        if known == effect and name.endswith(ends) and abs(value) > most:
            return f"over {most:g}"
    return None
