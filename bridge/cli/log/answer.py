"""The diagnosis in plain sentences, as the command prints it."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.document.findings import clock, finding_text
from gapbridge.bridge.report.labels import parameter_unit, unit_of
from gapbridge.core.diagnosis.causes import Cause
from gapbridge.core.diagnosis.channel_diagnosis import ChannelDiagnosis, Verdict
from gapbridge.core.diagnosis.diagnosis import Diagnosis
from gapbridge.core.diagnosis.separation import Measurement
from gapbridge.core.effects import Reported
from gapbridge.core.log.columns import label
from gapbridge.core.log.log_finding import OTHER_ARM_CHECKS, LogFinding

VERDICTS = {
    Verdict.NO_GAP: "no gap: nothing stands above the noise",
    Verdict.EXPLAINED: "explained: causes were found, what is left has no structure",
    Verdict.PARTLY_EXPLAINED: "partly explained: causes were found, but residual structure remains",
    Verdict.UNEXPLAINED: "unexplained: there is a gap that no effect of the catalogue accounts for",
}
SHOWN = 6  # next measurements
CHANGED = 3  # parameters of a cause that changed between sessions


def answer(diagnosis: Diagnosis) -> str:
    """Return the whole answer, lines joined; joints count from 1."""
    lines = [f"verdict: {VERDICTS[diagnosis.verdict]}"]
    several = len(diagnosis.channels) > 1
    for channel in diagnosis.channels:
        verdict = f": {VERDICTS[channel.verdict]}" if several else ""
        lines += ["", f"{channel.channel}{verdict}", *_channel(channel, diagnosis.sessions)]
    if diagnosis.not_observable:
        lines.append("")
    for hidden in diagnosis.not_observable:
        lines.append(f"{hidden.channel}: not observable here; needs {', '.join(hidden.needs)}")
    notes = [finding_text(f) for f in diagnosis.findings if f not in other_arm(diagnosis)]
    if notes:
        lines += ["", *(f"note: {note}" for note in notes)]
    if diagnosis.next_measurements:
        lines += ["", "worth measuring next:"]
        lines += [f"  {_measurement(m)}" for m in diagnosis.next_measurements[:SHOWN]]
        more = len(diagnosis.next_measurements) - SHOWN
        lines += [f"  ... and {more} more in the JSON"] if more > 0 else []
    return "\n".join(lines)


def other_arm(diagnosis: Diagnosis) -> list[LogFinding]:
    """Return where the measured poses are not those of the cell's arm: warnings, not notes."""
    own = [f for f in diagnosis.findings if isinstance(f, LogFinding)]
    return [f for f in own if f.check in OTHER_ARM_CHECKS]


def size(value: float | None, unit: str) -> str:
    """Return a gap as text, m as mm and rad as mrad."""
    if value is None:
        return "unknown"
    name, factor = unit_of(unit)
    return f"{value * factor:.4g} {name}"


def _both(channel: ChannelDiagnosis, rms: float | None) -> str:
    """Return an rms per coordinate, beside it the same as a distance in space."""
    if rms is None or channel.channel != "position":
        return f"{size(rms, channel.unit)} rms per coordinate"
    in_space = size(3**0.5 * rms, channel.unit)
    return f"{size(rms, channel.unit)} rms per coordinate ({in_space} in space)"


def _channel(channel: ChannelDiagnosis, sessions: tuple[str, ...]) -> list[str]:
    unit = channel.unit
    most = "at most" if channel.channel != "position" else "at most in space"
    lines = [
        f"  gap {_both(channel, channel.gap_rms)}, {most} {size(channel.gap_max, unit)}, over "
        f"{channel.samples} samples; noise {size(channel.noise_floor_rms, unit)} per coordinate",
    ]
    for cause in channel.causes:
        lines += [f"  {line}" for line in _cause(cause, unit)]
        lines += [f"    {line}" for line in _changed(channel, cause, sessions)]
    if channel.causes:
        lines.append(f"  remaining with these values {_both(channel, channel.remaining_rms)}")
        lines.append(
            f"  on samples held out {_both(channel, channel.remaining_rms_held_out)}, "
            "these causes alone fitted to the others"
        )
    lines += [f"  {line}" for line in _elsewhere(channel, sessions)]
    for stand_in in channel.stand_ins:
        lines.append(
            f"  stand-in: {_named(stand_in)}: not proved, but the gap shrinks by it in regions "
            "that the fit did not see; --apply --stand-ins puts it into the model"
        )
    if channel.structured:
        depends = ", ".join(
            f"{label(name)} ({share:.0%})" for name, share in channel.depends_on[:4]
        )
        lines.append(
            f"  unexplained: {size(channel.unexplained_rms, unit)} with structure"
            + (f"; it depends on {depends}" if depends else "")
        )
    return lines


def _elsewhere(channel: ChannelDiagnosis, sessions: tuple[str, ...]) -> list[str]:
    """Return what to expect where nothing was fitted; a figure that cannot be had is said to be."""
    unit, found = channel.unit, channel.generalisation
    region = "unknown (too few samples)" if found.new_region is None else size(
        found.new_region, unit)  # fmt: skip
    session = "unknown (one session)" if found.new_session is None else size(
        found.new_session, unit)  # fmt: skip
    lines = [f"to expect in a new region of joint space {region}, in a new session {session}"]
    if found.by_session:
        each = ", ".join(f"{sessions[s]} {size(rms, unit)}" for s, rms in found.by_session)
        lines.append(f"each session under a fit of the others: {each}")
    return lines


def _changed(channel: ChannelDiagnosis, cause: Cause, sessions: tuple[str, ...]) -> list[str]:
    """Return whether a cause carries from session to session, with its values where not."""
    across = next((c for c in channel.session_transfer if c.effect == cause.effect), None)
    if across is None:
        return []
    if across.transfers:
        return [f"carries: the same in {len(across.values)} sessions"]
    lines = [f"changed between sessions (p = {across.p_value:.2g} if it had not):"]
    most = _most_changed([parameters for _, parameters in across.values])
    for s, parameters in across.values:
        each = "; ".join(_parameter(parameters[k]) for k in most)
        lines.append(f"  {sessions[s]}: {each}")
    if len(most) < len(across.values[0][1]):
        lines.append("  (those that changed most; all are in the JSON)")
    return lines


def _most_changed(values: Sequence[Sequence[Reported]]) -> list[int]:
    """Return the indices of the parameters that differ most, in sigmas, most first."""
    sigmas = []
    for same in zip(*values, strict=True):
        numbers = [p.value for p in same]
        spread = max((p.std or 0.0) for p in same)
        sigmas.append((max(numbers) - min(numbers)) / max(spread, 1e-300))
    order = sorted(range(len(sigmas)), key=lambda k: -sigmas[k])
    return order[:CHANGED]


def _cause(cause: Cause, unit: str) -> list[str]:
    lines = [f"cause: {_named(cause)} (probability {cause.probability:.3g}){_shrink(cause)}"]
    if cause.shrink is not None:
        lines.append(
            f"  held-out gap {size(cause.shrink.gap_without, unit)} without it, "
            f"{size(cause.shrink.gap_with, unit)} with it"
        )
    lines += [f"  {_parameter(parameter)}" for parameter in cause.parameters]
    if cause.indistinguishable_from:
        ties = ", ".join(cause.indistinguishable_from)
        lines.append(f"  these data cannot separate it from {ties}")
    return lines


def _named(cause: Cause) -> str:
    if not cause.joints:
        return cause.effect
    plural = "s" if len(cause.joints) > 1 else ""
    return f"{cause.effect} of joint{plural} {', '.join(str(j) for j in cause.joints)}"


def _shrink(cause: Cause) -> str:
    if cause.shrink is None:
        return ""
    low, high = cause.shrink.interval
    return f": shrinks the gap by {cause.shrink.shrink:.1%} ({low:.1%} to {high:.1%})"


def _parameter(parameter: Reported) -> str:
    if parameter.is_time:
        return f"{parameter.name} = {clock(parameter.value, dated=True)}"
    unit, factor = parameter_unit(parameter)
    spread = "" if parameter.std is None else f" ± {factor * parameter.std:.2g}"
    return f"{parameter.name} = {factor * parameter.value:.5g}{spread} {unit}".rstrip()


def _measurement(m: Measurement) -> str:
    q = ", ".join(f"{v:.3f}" for v in m.q)
    purpose = f"separates {' from '.join(m.separates)}" if len(m.separates) > 1 else (
        f"would show {m.separates[0]}"
    )  # fmt: skip
    came = ""
    if m.approach:
        came = f", last motions {' '.join(f'{a:+d}' for a in m.approach)}"
    if m.velocity and m.acceleration:
        speeds = ", ".join(f"{v:.2f}" for v in m.velocity)
        came += f", in motion at [{speeds}] rad/s"
        came += f" and [{', '.join(f'{a:.1f}' for a in m.acceleration)}] rad/s2"
    return f"q = [{q}] rad with {m.payload:.3g} kg{came}: {purpose}"
