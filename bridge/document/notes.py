"""Texts of the notes of a fit, a calibration or a plan, and of their results."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from gapbridge.bridge.document.log_findings import FORMATTER
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.notes import Note, Reason

MIN_MOVE_SIGMAS = 2.5  # a tool that moved by less is reported as unmoved
DOWN = "down-weighted as outlier: "
MOSTLY = "{0} and {1}: mostly their %s is known (correlation {2:+.3f})"
ONLY = "{0}: these readings determine only its %s with {1}"
TEXTS = {
    Reason.OUTLIERS: "{0} outlier(s) down-weighted",
    Reason.NOT_CONVERGED: "the fit did not converge: its values are those of the last step; fit "
    "fewer effects or measure more poses",
    Reason.SUM_KNOWN: MOSTLY % "sum",
    Reason.DIFFERENCE_KNOWN: MOSTLY % "difference",
    Reason.AT_ZERO: "at their bound of zero: {0}",
    Reason.NO_FLEXIBILITY: "no flexibility is identifiable from these data: the cell's are kept",
    Reason.SESSION_FRAMES: "each session has its own frame, which is not written to the cell",
    Reason.NOTHING_WRITTEN: "frame and tool point were also estimated and are not written to the "
    "cell",
    Reason.TOOL_WRITTEN: "frame and tool point were also estimated; the tool point is written to "
    "the cell",
    Reason.LINKS_HELD: "links or joints' zeros are also off; they were held nominal, since the "
    "cell without them would be less accurate than before, so the flexibilities partly "
    "compensate for them: run diagnose",
    Reason.LINKS_ESTIMATED: "links and joints' zeros were also estimated (they fit the poses "
    "better) and are not written to the cell: run diagnose to identify them",
    Reason.TOOL_OFF_WRITTEN: "the tool point is off: the estimated one is written to the cell",
    Reason.TOOL_OFF: "the tool point is off: the estimated one is not written to the cell",
    Reason.HELD: "{0}: not identifiable from these data, stays at the model's value",
    Reason.ACTS_LIKE: "{0}: not identifiable alone from these data, it acts like {1:members}; "
    "their sum is written there, this one stays at the model's value",
    Reason.SHOWN_TOGETHER: "{0:members}: identifiable only together; they stay at the "
    "model's values",
    Reason.ONLY_SUM: ONLY % "sum",
    Reason.ONLY_DIFFERENCE: ONLY % "difference",
    Reason.ONLY_TOGETHER: "{0}: these readings determine it only together with {1}",
    Reason.HARDLY_SHOWN: "{0}: hardly identifiable from these readings; it stays near its start",
    Reason.NEVER_SHOWN: "{0}: no load or reading of this session shows it",
    Reason.REDUNDANT: "{0}: the same as {1:and}; its effect is included there",
    Reason.REDUNDANT_WITH_PLACE: "{0}: the same as {1:place}; its effect is included there",
    Reason.ON_BOUND: "on their bound: {0}",
    Reason.HELD_OUT_FAR: "held-out reading(s) far beyond the predicted spread: row {0}",
    Reason.LOADS_AT_ODDS: "the differences between loads and all readings together give different "
    "flexibilities: something else changed with the load, or between the loads (a wrong payload, "
    "a tool that slipped, an instrument that moved)",
    Reason.SAME_LOADS: "no pose was measured under two loads: flexibilities are estimated from "
    "geometry and load together",
    Reason.VERIFYING_FITTED: "{0} verification reading(s) were fitted: too few others determine "
    "the place of their instrument or target",
    Reason.FRAME_FITTED: "the instrument's place was fitted to these poses: a turn of the whole "
    "arm, or another zero of joint 1, is not observable",
    Reason.FEW_NUMBERS: "only {0} values are available for the check: measure more poses",
    Reason.NOTHING: "no remaining error that a further effect could explain",
    Reason.UNCONVERGED: "the fit did not converge",
    Reason.EFFECTS_MISSING: "effects to add, with the share of the remaining error that each "
    "removes on held-out poses: {0:shares}",
    Reason.EFFECTS_ACCUSED: "{0} is still to be added",
    Reason.STRUCTURE: "structure remains that no effect of the catalogue explains",
    Reason.FAR_OFF: "the error of held-out poses is {0:.1f} times the predicted one",
    Reason.NOTHING_WEIGHS: "the sensor carries no load: no centre of gravity can be estimated",
    Reason.NEGATIVE_MASS: "the load weighs {0:.3f} kg: the sensor's signs or axes are not those of "
    "a log (a mass at rest reads its weight, pointing down, in flange axes)",
    Reason.READINGS_DOWN: DOWN + "reading {0}",
    Reason.TOUCHES_DOWN: DOWN + "touch {0}",
    Reason.NOT_IDENTIFIABLE: "not identifiable from these poses: {0}",
    Reason.IDLE_LOADS: "loads that add no information and need not be attached: {0:kg}",
    Reason.ONE_LOAD: "only one load: compliance is identified from the arm's own weight; a second "
    "load determines it better",
    Reason.SIGHT_UNKNOWN: "the instrument's place is unknown: its line of sight was not checked",
    Reason.DETOURS: "no straight path in joint space, make a detour: stops {0:ways}",
    Reason.FEW_POSES: "few poses to choose from: {0:rejected}",
    Reason.FEW_HELD_OUT: "{0} of {1} held-out poses are planned: the fit uses the others",
    Reason.NO_STAMPS: "{0}: {1} of {2} messages have no stamp in their header; the time of "
    "recording is used instead",
    Reason.NO_TARGET: "target_q: no topic has it, so that tracking cannot be observed",
    Reason.WRENCH_UNKNOWN: "{0}: left out; gapbridge convert takes it with --wrench {1:or}, which "
    "says what it measures",
    Reason.POSE_UNNAMED: "{0}: left out; gapbridge convert takes the tracker's with --topic "
    "pose=TOPIC",
    Reason.NO_ROTATION: "{0}: orientation left out; {1} of {2} messages have none",
    Reason.TAKEN_AS: "{0}: taken as {1}, its axes are those of {2!r}",
    Reason.EFFORT_UNKNOWN: "{0}: effort left out; where it is Nm (some drivers report A), "
    "gapbridge convert takes it with --effort-is-torque",
    Reason.NO_COMMON_TIME: "{0}: shares no time with {1}, left out",
    Reason.GAPS: "{0}: {1} gaps, the longest {2:.3g} s",
    Reason.UNCOVERED: "{0} of {1} rows left out: not covered by every topic",
    Reason.FRAME_TIMES: "timestamp is the frame's number over {0:g} Hz, not measured: a latency "
    "below {1:.0f} ms cannot be given",
    Reason.EPISODES: "{0} episodes in a row, {1:g} s between two",
    Reason.MIDDLE_ZERO: "a joint's zero is the middle of its calibrated range, not the model's",
    Reason.BEHIND_GEARS: "actual_current_as_torque is tau_J: measured behind the gears, without "
    "the motor's friction and inertia",
    Reason.MISSING: "{0} rows without a value of {1}",
    Reason.DAMAGED: "{0}: chunk at byte {1} is damaged: {2} bytes were left out",
}


def note_text(note: Note, title: Callable[[str], str] = str) -> str:
    """Return a note as a sentence; ``title`` maps names of parameters and effects to titles."""
    values = tuple(_titled(value, title) for value in note.values)
    return FORMATTER.vformat(TEXTS[note.reason], values, {})


def note_texts(notes: Iterable[Note], title: Callable[[str], str] = str) -> tuple[str, ...]:
    """Return notes as sentences; ``title`` as in ``note_text``."""
    return tuple(note_text(note, title) for note in notes)


def _titled(value: Any, title: Callable[[str], str]) -> Any:
    if isinstance(value, str):
        return title(value)
    if isinstance(value, tuple | list):
        return tuple(_titled(v, title) for v in value)
    return value


def calibration_text(result: Calibration, title: Callable[[str], str] = str) -> str:
    """Return a calibration in one sentence; ``title`` as in ``note_text``."""
    held_out = len(result.held_out_before.rows) > 0
    before, after = result.before, result.after
    if held_out:
        before, after = result.held_out_before, result.held_out_after
    where = "on held-out poses" if held_out else "on the fitted poses (none held out)"
    change = "rises" if after.rms > before.rms else "falls"
    text = (
        f"the error {change} from {1e3 * before.rms:.3f} to {1e3 * after.rms:.3f} mm rms {where}; "
        f"the fit leaves {1e3 * result.noise:.3f} mm per coordinate"
    )
    if np.isfinite(result.noise_floor):
        text += f" (instrument and arm alone: {1e3 * result.noise_floor:.3f} mm)"
    return (
        f"{text}; {'' if result.complete else 'not complete: '}{note_text(result.remaining, title)}"
    )


def short_text(result: PayloadCalibration | ToolCalibration) -> str:
    """Return the result of a short session in one sentence."""
    return _payload(result) if isinstance(result, PayloadCalibration) else _tool(result)


def _payload(result: PayloadCalibration) -> str:
    for note in result.notes:
        if note.reason in (Reason.NOTHING_WEIGHS, Reason.NEGATIVE_MASS):
            return note_text(note)
    mass, *centre = result.estimates[:4]
    low, high = mass.interval
    return (
        f"the load weighs {mass.value:.3f} kg ({low:.3f} to {high:.3f}); standard deviation of its "
        f"centre of gravity {1e3 * max(e.std for e in centre):.1f} mm"
    )


def _tool(result: ToolCalibration) -> str:
    std = float(np.linalg.norm([e.std for e in result.estimates]))
    if result.moved < MIN_MOVE_SIGMAS * std:
        return f"the tool's tip agrees with the cell; standard deviation {1e3 * std:.2f} mm"
    return (
        f"the tool's tip is {1e3 * result.moved:.2f} mm from the cell's (standard deviation "
        f"{1e3 * std:.2f} mm)"
    )
