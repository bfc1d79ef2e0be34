"""The words for what is odd about a log, or suspected of it."""

from __future__ import annotations

from string import Formatter
from typing import Any

from gapbridge.core.log.columns import label
from gapbridge.core.log.log_finding import LogCheck, LogFinding

POSITIONS_OFF = "the measured positions do not follow the arm: {0:.0f mm} off in any frame; "
ROTATIONS_OFF = "the measured rotations do not follow the arm: "
PULL = "actual_TCP_force looks {}; expected what the surroundings do to the tool, in base axes"
TEXTS = {
    LogCheck.MISSPELT: "a column was left out; found {0}; did you mean {1}?",
    LogCheck.CLOCKS_OVERLAP: "the sessions' timestamps overlap: each has a clock of its own, so "
    "nothing is said of the time between them",
    LogCheck.COPIED_ROWS: "{0} of {1} rows repeat the timestamp before (the first is row {2}); the "
    "moving channels leave them out",
    LogCheck.ROUNDED_TIME: "timestamps are rounded to {0:.3g} s and repeat in {1} rows (the first "
    "is row {2}); the rows were taken as evenly spaced",
    LogCheck.AMBIGUOUS_TIME: "row {0}, column timestamp: found {1:g} again (as in {2} of {3} "
    "rows), expected a time of its own per row",
    LogCheck.REPEATED_TIME: "{0} timestamp(s) are repeated",
    LogCheck.BACKWARD_TIME: "{0} timestamp(s) run backwards: rows should be in time order",
    LogCheck.NO_READING: "{0} row(s) have no {1:reading} and were left out",
    LogCheck.POSITIONS_AT_REST: "the measured positions hardly move: is it the right column?",
    LogCheck.FAHRENHEIT: "the joint temperatures look like Fahrenheit, expected °C",
    LogCheck.FEW_POSES: "{0} different pose(s) are few: what is found may be one of several "
    "explanations; 30 or more that use the joints' whole range separate causes",
    LogCheck.BEYOND_LIMITS: "joint(s) {0} stand beyond the limits of the cell's arm: is it the "
    "right arm?",
    LogCheck.BEYOND_SESSIONS: "session {0} goes beyond the other sessions in {1:columns}: its "
    "figure as a new session holds for rows unlike those fitted",
    LogCheck.BEYOND_FITTED: "{0:columns}: {1} of {2} rows lie outside what was fitted, {3:.4g} to "
    "{4:.4g} {5} (row {6}: {7:.4g})",
    LogCheck.NOT_IN_BASE: "the measured positions lie {0:.0f mm} from where the arm is, and fit it "
    "in a frame of their own: they are not in base; set metrology.registered to false",
    LogCheck.POSITIONS_OFF: POSITIONS_OFF + "is it the right arm, tool and order of joints and "
    "rows?",
    LogCheck.POSITIONS_OFF_BY: POSITIONS_OFF + "{1:finding}: then {2:.1f mm}",
    LogCheck.ROTATIONS_OFF: ROTATIONS_OFF + "{0:.1f} rad off; expected rotation vectors of the TCP",
    LogCheck.ROLL_PITCH_YAW: ROTATIONS_OFF + "they look like roll, pitch and yaw, expected "
    "rotation vectors",
    LogCheck.TARGET_AXES: "the measured rotations are turned by {0:.2f} rad against the cell's "
    "tool, the same in every pose: the target's axes are not those of tool.tcp",
    LogCheck.MIRRORED: "they look mirrored (a left-handed frame, or two axes swapped)",
    LogCheck.INVERTED: "they look inverted: the base seen from the tool",
    LogCheck.JOINT_SIGN: "joint {0} looks turned round in sign",
    LogCheck.ROW_LATE: "they look one row too late",
    LogCheck.ROW_EARLY: "they look one row too early",
    LogCheck.LENGTH_UNIT: "they look like {0}, expected m",
    LogCheck.OTHER_ARM: "they look like those of a {0}",
    LogCheck.FLANGE_NOT_TCP: "they look like the flange's, not the TCP's (tool.tcp)",
    LogCheck.TCP_SIGN: "tool.tcp looks turned round in sign",
    LogCheck.MODIFIED_DH: "robot.dh looks like modified DH rows (Craig), expected standard ones",
    LogCheck.DH_SIGN: "{0} of the DH rows looks turned round in sign",
    LogCheck.DH_UNIT: "lengths of the DH rows look like {0}, expected m",
    LogCheck.NO_TCP: "the measured point lies at {0:point} in the flange's frame, the cell "
    "declares no tool (tool.tcp)",
    LogCheck.OTHER_TCP: "the measured point lies at {0:point} in the flange's frame, tool.tcp "
    "says {1:point}",
    LogCheck.JOINTS_SWAPPED: "joints {0} and {1} look swapped",
    LogCheck.UR_JOINTS_SWAPPED: "joints {0} and {1} look swapped (a UR's elbow and shoulder pan, "
    "as sorted by name)",
    LogCheck.JOINTS_REVERSED: "the joints look turned round in order",
    LogCheck.JOINT_ORDER: "the joints look out of order: {0:order}",
    LogCheck.PULL_SIGN: PULL.format("turned round in sign"),
    LogCheck.PULL_IN_TOOL: PULL.format("given in tool axes"),
    LogCheck.PULL_SIGN_IN_TOOL: PULL.format("turned round in sign and given in tool axes"),
    LogCheck.WRENCH_SIGN: "ft_raw_wrench looks turned round in sign; expected what the load does "
    "to the sensor (a mass at rest reads its weight, pointing down)",
    LogCheck.TORQUE_SIGN: "actual_current_as_torque looks turned round in sign; expected what the "
    "motors deliver",
    LogCheck.MISSING_FLEXIBILITY: "position: the cell names no joint flexibility, and so many "
    "causes are hard to prove one by one; asked for alone (`gapbridge fit`), {0} flexibilities "
    "take the gap from {1:.3g mm} to {2:.3g mm} on poses that their fit did not see: fit "
    "first, then diagnose what is left",
}
WAYS = 8  # between stops, that are named
READINGS = {
    "measured_position": "measured position",
    "measured_rotation": "measured rotation",
    "ft_raw_wrench": "wrench",
    "actual_current_as_torque": "joint torques",
}


def log_finding_text(finding: LogFinding) -> str:
    """Return a finding as a sentence."""
    text = FORMATTER.vformat(TEXTS[finding.check], finding.values, {})
    return f"session {', '.join(finding.sessions)}: {text}" if finding.sessions else text


class _Formatter(Formatter):
    """What the texts ask for beside Python's own formats: ``mm``, ``column`` and the like."""

    def format_field(self, value: Any, format_spec: str) -> str:
        match format_spec:
            case "":
                several = isinstance(value, (tuple, list))  # a list where it was read from JSON
                return ", ".join(map(str, value)) if several else str(value)
            case "and":
                return " and ".join(value)
            case "or":
                return " or ".join(value)
            case "rejected":  # a sentence in older journals
                from gapbridge.core.planning.candidates import RejectedPoses  # a plan's, and large

                return value if isinstance(value, str) else str(RejectedPoses(*value))
            case "place":
                return " and ".join((*value, "where instrument or target stand"))
            case "kg":
                return ", ".join(f"{mass:g} kg" for mass in value)
            case "members":
                return " ".join(f"{share:+.2f} {name}" for share, name in value)
            case "shares":
                return ", ".join(f"{name} ({100 * share:.0f} %)" for name, share in value)
            case "ways":
                more = f" and {len(value) - WAYS} more" if len(value) > WAYS else ""
                return ", ".join(f"{a} to {b}" for a, b in value[:WAYS]) + more
            case "finding":
                return log_finding_text(value)
            case "columns":
                return ", ".join(label(column) for column in value)
            case "reading":
                return READINGS[value]
            case "order":
                return ", ".join(f"joint {i} is column _{k}" for i, k in value)
            case "point":
                return f"({', '.join(f'{1e3 * x:.0f}' for x in value)}) mm"
        if format_spec.endswith(" mm"):
            return f"{1e3 * value:{format_spec.removesuffix(' mm')}} mm"
        return str(super().format_field(value, format_spec))


FORMATTER = _Formatter()
