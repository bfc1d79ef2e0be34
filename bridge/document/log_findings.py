"""Texts of the findings of log checks."""

from __future__ import annotations

from string import Formatter
from typing import Any

from gapbridge.core.log.columns import label
from gapbridge.core.log.log_finding import LogCheck, LogFinding

POSITIONS_OFF = "the measured positions do not follow the arm: {0:.0f mm} off in any frame; "
ROTATIONS_OFF = "the measured rotations do not follow the arm: "
PULL = "actual_TCP_force seems {}; expected what the surroundings do to the tool, in base axes"
LAG = "{}_* seems to come about {{0:lag}} the joint angles; expected both on one clock"
TEXTS = {
    LogCheck.MISSPELT: "a column was left out; found {0}; did you mean {1}?",
    LogCheck.CLOCKS_OVERLAP: "the sessions' timestamps overlap: each has its own clock, so the "
    "time between them is unknown",
    LogCheck.COPIED_ROWS: "{0} of {1} rows repeat the timestamp before (the first is row {2}); the "
    "moving channels leave them out",
    LogCheck.ROUNDED_TIME: "timestamps are rounded to {0:.3g} s and repeat in {1} rows (the first "
    "is row {2}); the rows were taken as evenly spaced",
    LogCheck.AMBIGUOUS_TIME: "row {0}, column timestamp: found {1:g} again (as in {2} of {3} "
    "rows), expected a different time in each row",
    LogCheck.REPEATED_TIME: "{0} timestamp(s) are repeated",
    LogCheck.BACKWARD_TIME: "{0} timestamp(s) run backwards (the first is row {1}): rows should be "
    "in time order",
    LogCheck.WHOLE_TURNS: "joint(s) {0} jump by whole turns, or are commanded on another turn; "
    "their angles were continued",
    LogCheck.WRONG_SPEEDS: "actual_qd of joint(s) {0} is {1:.3g} times what the angles change by, "
    "expected rad/s; the column was left out, and speeds were taken from the angles",
    LogCheck.NO_READING: "{0} row(s) have no {1:reading} and were left out",
    LogCheck.POSITIONS_AT_REST: "the measured positions hardly change: is it the right column?",
    LogCheck.FAHRENHEIT: "the joint temperatures look like Fahrenheit, expected °C",
    LogCheck.FEW_POSES: "{0} different pose(s) are few: the result may be one of several "
    "explanations; 30 or more over the joints' whole range separate causes",
    LogCheck.BEYOND_LIMITS: "joint(s) {0} are beyond the limits of the cell's arm: is it the "
    "right arm?",
    LogCheck.BEYOND_SESSIONS: "session {0} is beyond the range of the other sessions in "
    "{1:columns}: its figure as a new session is an extrapolation",
    LogCheck.BEYOND_FITTED: "{0:columns}: {1} of {2} rows lie outside what was fitted, {3:.4g} to "
    "{4:.4g} {5} (row {6}: {7:.4g})",
    LogCheck.NOT_IN_BASE: "the measured positions lie {0:.0f mm} from the arm's TCP, and fit it in "
    "another frame: they are not in base; set metrology.registered to false",
    LogCheck.POSITIONS_OFF: POSITIONS_OFF + "is it the right arm, tool and order of joints and "
    "rows?",
    LogCheck.POSITIONS_OFF_BY: POSITIONS_OFF + "{1:finding}: then {2:.1f mm}",
    LogCheck.ROTATIONS_OFF: ROTATIONS_OFF + "{0:.1f} rad off; expected rotation vectors of the TCP",
    LogCheck.ROLL_PITCH_YAW: ROTATIONS_OFF + "they look like roll, pitch and yaw, expected "
    "rotation vectors",
    LogCheck.TARGET_AXES: "the measured rotations differ by a constant {0:.2f} rad from the "
    "cell's tool: the target's axes are not those of tool.tcp",
    LogCheck.TARGET_REMOUNTED: "the target's axes differ from session to session: if it was "
    "remounted in between, add --remounted",
    LogCheck.MIRRORED: "they look mirrored (a left-handed frame, or two axes swapped)",
    LogCheck.INVERTED: "they look inverted: the base seen from the tool",
    LogCheck.JOINT_SIGN: "joint {0} seems to have the wrong sign",
    LogCheck.ROW_LATE: "they look one row too late",
    LogCheck.ROW_EARLY: "they look one row too early",
    LogCheck.LENGTH_UNIT: "they look like {0}, expected m",
    LogCheck.OTHER_ARM: "they look like those of a {0}",
    LogCheck.FLANGE_NOT_TCP: "they look like the flange's, not the TCP's (tool.tcp)",
    LogCheck.TCP_SIGN: "tool.tcp seems to have the wrong sign",
    LogCheck.MODIFIED_DH: "robot.dh looks like modified DH rows (Craig), expected standard ones",
    LogCheck.DH_SIGN: "{0} of the DH rows seems to have the wrong sign",
    LogCheck.DH_UNIT: "lengths of the DH rows look like {0}, expected m",
    LogCheck.NO_TCP: "the measured point lies at {0:point} in the flange's frame, the cell "
    "declares no tool (tool.tcp)",
    LogCheck.OTHER_TCP: "the measured point lies at {0:point} in the flange's frame, tool.tcp "
    "says {1:point}",
    LogCheck.JOINTS_SWAPPED: "joints {0} and {1} look swapped",
    LogCheck.UR_JOINTS_SWAPPED: "joints {0} and {1} look swapped (a UR's elbow and shoulder pan, "
    "as sorted by name)",
    LogCheck.JOINTS_REVERSED: "the joints seem to be in reverse order",
    LogCheck.JOINT_ORDER: "the joints look out of order: {0:order}",
    LogCheck.COMMAND_ORDER: "target_q does not follow actual_q: its joints look out of order: "
    "{0:order}",
    LogCheck.PULL_SIGN: PULL.format("to have the wrong sign"),
    LogCheck.PULL_IN_TOOL: PULL.format("to be in tool axes"),
    LogCheck.PULL_SIGN_IN_TOOL: PULL.format("to have the wrong sign and to be in tool axes"),
    LogCheck.WRENCH_SIGN: "ft_raw_wrench seems to have the wrong sign; expected what the load does "
    "to the sensor (a mass at rest reads its weight, pointing down)",
    LogCheck.TORQUES_FIRST: "ft_raw_wrench seems to hold torques before forces; expected forces in "
    "_0 to _2, torques in _3 to _5",
    LogCheck.LEFT_HANDED_WRENCH: "ft_raw_wrench seems to be in left-handed axes: its forces are "
    "those along {0}, {1} and {2} of the flange; expected x, y and z",
    LogCheck.TORQUE_SIGN: "actual_current_as_torque seems to have the wrong sign; expected what "
    "the motors deliver",
    LogCheck.TORQUE_UNSIGNED: "actual_current_as_torque is never negative, though joints turn both "
    "ways; expected torques with a sign, not their size (a hobby servo's current has none)",
    LogCheck.CURRENTS: "actual_current_as_torque is only {0:.2f} times what the links weigh at "
    "joints {1}: it looks like currents (A), expected torques (Nm)",
    LogCheck.WRENCH_LAG: LAG.format("ft_raw_wrench"),
    LogCheck.TORQUE_LAG: LAG.format("actual_current_as_torque"),
    LogCheck.GRAVITY: "the joint torques show weights that pull along {0:vector} m/s² of the base, "
    "the cell's gravity is {1:vector}: is the base mounted as the cell says?",
    LogCheck.MISSING_FLEXIBILITY: "position: the cell has no joint flexibility, which hides other "
    "causes; a fit of {0} flexibilities alone (`gapbridge fit`) reduces the gap from {1:.3g mm} "
    "to {2:.3g mm} on held-out poses: fit first, then diagnose what remains",
}
MAX_LISTED = 8  # moves between stops that are listed
READINGS = {
    "measured_position": "measured position (empty, or three zeros)",
    "measured_rotation": "measured rotation",
    "ft_raw_wrench": "wrench",
    "actual_current_as_torque": "joint torques",
}


def log_finding_text(finding: LogFinding) -> str:
    """Return a finding as a sentence."""
    text = FORMATTER.vformat(TEXTS[finding.check], finding.values, {})
    return f"session {', '.join(finding.sessions)}: {text}" if finding.sessions else text


class _Formatter(Formatter):
    """Python's formats, and those of the texts: ``mm``, ``columns`` and others."""

    def format_field(self, value: Any, format_spec: str) -> str:
        match format_spec:
            case "":
                several = isinstance(value, (tuple, list))  # a list where it was read from JSON
                return ", ".join(map(str, value)) if several else str(value)
            case "and":
                return " and ".join(value)
            case "or":
                return " or ".join(value)
            case "rejected":
                from gapbridge.core.planning.candidates import RejectedPoses  # a plan's, and large

                return str(RejectedPoses(*value))
            case "place":
                return " and ".join((*value, "the place of instrument or target"))
            case "kg":
                return ", ".join(f"{mass:g} kg" for mass in value)
            case "members":
                return " ".join(f"{share:+.2f} {name}" for share, name in value)
            case "shares":
                return ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in value)
            case "ways":
                more = f" and {len(value) - MAX_LISTED} more" if len(value) > MAX_LISTED else ""
                return ", ".join(f"{a} to {b}" for a, b in value[:MAX_LISTED]) + more
            case "finding":
                return log_finding_text(value)
            case "columns":
                return ", ".join(label(column) for column in value)
            case "reading":
                return READINGS[value]
            case "order":
                return ", ".join(f"joint {i} is column _{k}" for i, k in value)
            case "vector":
                return f"[{', '.join(f'{x:.1f}' for x in value)}]"
            case "lag":
                return f"{abs(value):.2f} s {'after' if value > 0 else 'before'}"
            case "point":
                return f"({', '.join(f'{1e3 * x:.0f}' for x in value)}) mm"
        if format_spec.endswith(" mm"):
            return f"{1e3 * value:{format_spec.removesuffix(' mm')}} mm"
        return str(super().format_field(value, format_spec))


FORMATTER = _Formatter()
