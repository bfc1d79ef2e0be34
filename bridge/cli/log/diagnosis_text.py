"""The diagnosis as text, as the command prints it."""

from __future__ import annotations

from collections.abc import Sequence

from gapbridge.bridge.document.diagnosis_json import session_parameter
from gapbridge.bridge.document.findings import finding_text
from gapbridge.bridge.document.numbers import unit_of
from gapbridge.bridge.report.labels import parameter_unit
from gapbridge.bridge.report.slips import moment_of, slip_findings, slip_texts
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
    Verdict.UNEXPLAINED: "unexplained: there is a gap, and no effect can be named as its cause",
}
MAX_SHOWN = 6  # next measurements
MAX_CHANGED = 3  # parameters of a cause that changed between sessions


def diagnosis_text(diagnosis: Diagnosis) -> str:
    """Return the text of a diagnosis; joints count from 1."""
    lines = [f"verdict: {VERDICTS[diagnosis.verdict]}"]
    several = len(diagnosis.channels) > 1
    for channel in diagnosis.channels:
        verdict = f": {VERDICTS[channel.verdict]}" if several else ""
        lines += ["", f"{channel.channel}{verdict}", *_channel_lines(channel, diagnosis)]
        for slip, gap in slip_texts(diagnosis, channel):
            lines += [f"  slip: {slip}", f"    {gap}"]
    if diagnosis.not_observable:
        lines.append("")
    for missing in diagnosis.not_observable:
        lines.append(f"{missing.channel}: not observable here; needs {', '.join(missing.needs)}")
    elsewhere = [*wrong_arm_findings(diagnosis), *slip_findings(diagnosis)]
    notes = [finding_text(f) for f in diagnosis.findings if f not in elsewhere]
    if notes:
        lines += ["", *(f"note: {note}" for note in notes)]
    if diagnosis.next_measurements:
        lines += ["", "worth measuring next:"]
        lines += [f"  {_measurement_text(m)}" for m in diagnosis.next_measurements[:MAX_SHOWN]]
        more = len(diagnosis.next_measurements) - MAX_SHOWN
        lines += [f"  ... and {more} more in the JSON"] if more > 0 else []
    return "\n".join(lines)


def wrong_arm_findings(diagnosis: Diagnosis) -> list[LogFinding]:
    """Return the findings that poses or readings are not what they should be: warnings."""
    findings = [f for f in diagnosis.findings if isinstance(f, LogFinding)]
    return [f for f in findings if f.check in OTHER_ARM_CHECKS or f.misread]


def gap_text(value: float | None, unit: str) -> str:
    """Return a gap (SI) as text, in mm, mrad, N or Nm."""
    if value is None:
        return "unknown"
    name, factor = unit_of(unit)
    return f"{value * factor:.4g} {name}"


def _rms_text(channel: ChannelDiagnosis, rms: float | None) -> str:
    """Return an rms per coordinate; for positions also as a distance in space."""
    if rms is None or channel.channel != "position":
        return f"{gap_text(rms, channel.unit)} rms per coordinate"
    in_space = gap_text(3**0.5 * rms, channel.unit)
    return f"{gap_text(rms, channel.unit)} rms per coordinate ({in_space} in space)"


def _channel_lines(channel: ChannelDiagnosis, diagnosis: Diagnosis) -> list[str]:
    unit = channel.unit
    most = "at most" if channel.channel != "position" else "at most in space"
    lines = [
        f"  gap {_rms_text(channel, channel.gap_rms)}, {most} {gap_text(channel.gap_max, unit)}, "
        f"over {channel.samples} samples; noise {gap_text(channel.noise_floor_rms, unit)} per "
        "coordinate",
    ]
    for cause in channel.causes:
        lines += [f"  {line}" for line in _cause_lines(cause, unit, diagnosis)]
        lines += [f"    {line}" for line in _session_changes(channel, cause, diagnosis)]
    if channel.causes:
        lines.append(f"  remaining with these values {_rms_text(channel, channel.remaining_rms)}")
        lines.append(
            f"  on samples held out {_rms_text(channel, channel.remaining_rms_held_out)}, "
            "these causes alone fitted to the others"
        )
    lines += [f"  {line}" for line in _expected_elsewhere(channel, diagnosis.sessions)]
    for stand_in in channel.stand_ins:
        lines.append(
            f"  stand-in: {_cause_title(stand_in)}: not proved, but the gap shrinks by it in "
            "regions that the fit did not see; --apply --stand-ins puts it into the model"
        )
    if channel.structured:
        depends = ", ".join(
            f"{label(name)} ({share:.0%})" for name, share in channel.depends_on[:4]
        )
        lines.append(
            f"  unexplained: {gap_text(channel.unexplained_rms, unit)} with structure"
            + (f"; it depends on {depends}" if depends else "")
        )
    return lines


def _expected_elsewhere(channel: ChannelDiagnosis, sessions: tuple[str, ...]) -> list[str]:
    """Return the expected errors in new regions and sessions, or that they are unknown."""
    unit, elsewhere = channel.unit, channel.generalisation
    region = "unknown (too few samples)" if elsewhere.new_region is None else gap_text(
        elsewhere.new_region, unit)  # fmt: skip
    session = "unknown (one session)" if elsewhere.new_session is None else gap_text(
        elsewhere.new_session, unit)  # fmt: skip
    lines = [f"to expect in a new region of joint space {region}, in a new session {session}"]
    if elsewhere.by_session:
        each = ", ".join(f"{sessions[s]} {gap_text(rms, unit)}" for s, rms in elsewhere.by_session)
        lines.append(f"each session under a fit of the others: {each}")
    return lines


def _session_changes(channel: ChannelDiagnosis, cause: Cause, diagnosis: Diagnosis) -> list[str]:
    """Return whether a cause is the same in all sessions; if not, its values per session."""
    across = next((c for c in channel.session_transfer if c.effect == cause.effect), None)
    if across is None:
        return []
    if across.transfers:
        return [f"carries: the same in {len(across.values)} sessions"]
    lines = [f"changed between sessions (p = {across.p_value:.2g} if it had not):"]
    most = _most_changed([parameters for _, parameters in across.values])
    for s, parameters in across.values:
        each = "; ".join(_parameter_text(parameters[k], diagnosis) for k in most)
        lines.append(f"  {diagnosis.sessions[s]}: {each}")
    if len(most) < len(across.values[0][1]):
        lines.append("  (those that changed most; all are in the JSON)")
    return lines


def _most_changed(values: Sequence[Sequence[Reported]]) -> list[int]:
    """Return the indices of the parameters that differ most, in sigmas, most first."""
    sigmas = []
    for same in zip(*values, strict=True):
        numbers = [0.0 if p.is_time else p.value for p in same]
        spread = max((p.std or 0.0) for p in same)
        sigmas.append((max(numbers) - min(numbers)) / max(spread, 1e-300))
    order = sorted(range(len(sigmas)), key=lambda k: -sigmas[k])
    return order[:MAX_CHANGED]


def _cause_lines(cause: Cause, unit: str, diagnosis: Diagnosis) -> list[str]:
    lines = [
        f"cause: {_cause_title(cause)} (probability {cause.probability:.3g}){_shrink_text(cause)}"
    ]
    if cause.shrink is not None:
        lines.append(
            f"  held-out gap {gap_text(cause.shrink.gap_without, unit)} without it, "
            f"{gap_text(cause.shrink.gap_with, unit)} with it"
        )
    lines += [f"  {_parameter_text(parameter, diagnosis)}" for parameter in cause.parameters]
    if cause.indistinguishable_from:
        ties = ", ".join(cause.indistinguishable_from)
        lines.append(f"  these data cannot separate it from {ties}")
    return lines


def _cause_title(cause: Cause) -> str:
    if not cause.joints:
        return cause.effect
    plural = "s" if len(cause.joints) > 1 else ""
    return f"{cause.effect} of joint{plural} {', '.join(str(j) for j in cause.joints)}"


def _shrink_text(cause: Cause) -> str:
    if cause.shrink is None:
        return ""
    low, high = cause.shrink.interval
    return f": shrinks the gap by {cause.shrink.shrink:.1%} ({low:.1%} to {high:.1%})"


def _parameter_text(parameter: Reported, diagnosis: Diagnosis) -> str:
    if parameter.session:
        return f"{session_parameter(parameter)} = {parameter.session}"
    if parameter.is_time:
        return f"{parameter.name} = {moment_of(parameter, diagnosis)}"
    unit, factor = parameter_unit(parameter)
    spread = "" if parameter.std is None else f" ± {factor * parameter.std:.2g}"
    return f"{parameter.name} = {factor * parameter.value:.5g}{spread} {unit}".rstrip()


def _measurement_text(m: Measurement) -> str:
    q = ", ".join(f"{v:.3f}" for v in m.q)
    purpose = f"separates {' from '.join(m.separates)}" if len(m.separates) > 1 else (
        f"would show {m.separates[0]}"
    )  # fmt: skip
    motion = ""
    if m.approach:
        motion = f", last motions {' '.join(f'{a:+d}' for a in m.approach)}"
    if m.velocity and m.acceleration:
        speeds = ", ".join(f"{v:.2f}" for v in m.velocity)
        motion += f", in motion at [{speeds}] rad/s"
        motion += f" and [{', '.join(f'{a:.1f}' for a in m.acceleration)}] rad/s2"
    return f"q = [{q}] rad with {m.payload:.3g} kg{motion}: {purpose}"
