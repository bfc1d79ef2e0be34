"""The words for what a fit, a calibration or a plan notes, and for what they found."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from gapbridge.bridge.document.log_findings import FORMATTER
from gapbridge.core.calibration.payload_session import PayloadCalibration
from gapbridge.core.calibration.result import Calibration
from gapbridge.core.calibration.tool_session import ToolCalibration
from gapbridge.core.notes import Note, Reason

SURE = 2.5  # sigmas: a tool that moved by less is where it was
DOWN = "down-weighted as outlier: "
MOSTLY = "{0} and {1}: mostly their %s is known (correlation {2:+.3f})"
ONLY = "{0}: these readings determine only its %s with {1}"
TEXTS = {
    Reason.OUTLIERS: "{0} outlier(s) down-weighted",
    Reason.NOT_CONVERGED: "the fit did not converge: take its figures for where it stood, and fit "
    "fewer effects or measure more poses",
    Reason.SUM_KNOWN: MOSTLY % "sum",
    Reason.DIFFERENCE_KNOWN: MOSTLY % "difference",
    Reason.AT_ZERO: "at their bound of zero: {0}",
    Reason.NO_FLEXIBILITY: "these data show no flexibility: those of the cell stay as they are",
    Reason.SESSION_FRAMES: "each session has a frame of its own, not written to the cell",
    Reason.NOTHING_WRITTEN: "frame and tool point were estimated along and are not written to the "
    "cell",
    Reason.TOOL_WRITTEN: "frame and tool point were estimated along; the tool point is written to "
    "the cell",
    Reason.LINKS_HELD: "links or joints' zeros are off too; they were held nominal, since the cell "
    "without them would be worse than it was, so that flexibilities make up for them in part: "
    "diagnose names what holds",
    Reason.LINKS_ESTIMATED: "links and joints' zeros were estimated along (the poses are likelier "
    "with them); they are not written to the cell: diagnose names what of them holds",
    Reason.TOOL_OFF_WRITTEN: "the tool point is off: the one found is written to the cell",
    Reason.TOOL_OFF: "the tool point is off: the one found is not written to the cell",
    Reason.HELD: "{0}: not identifiable from these data, stays at the model's value",
    Reason.ACTS_LIKE: "{0}: not identifiable alone from these data, it acts like {1:members}; what "
    "they make together is written there, this one stays at the model's value",
    Reason.SHOWN_TOGETHER: "{0:members}: shown together, none of them alone; they stay at the "
    "model's values",
    Reason.ONLY_SUM: ONLY % "sum",
    Reason.ONLY_DIFFERENCE: ONLY % "difference",
    Reason.ONLY_TOGETHER: "{0}: these readings determine it only together with {1}",
    Reason.HARDLY_SHOWN: "{0}: these readings hardly show it; it stays near its beginning",
    Reason.NEVER_SHOWN: "{0}: nothing that is hung or read here shows it",
    Reason.REDUNDANT: "{0}: the same as {1:and}; what it adds is found there",
    Reason.REDUNDANT_WITH_PLACE: "{0}: the same as {1:place}; what it adds is found there",
    Reason.ON_BOUND: "on their bound: {0}",
    Reason.HELD_OUT_FAR: "held-out reading(s) far beyond the predicted spread: row {0}",
    Reason.LOADS_AT_ODDS: "what differs between loads and all readings together disagree on the "
    "flexibilities: something else changes with the load, or came between the loads (a wrong "
    "payload, a tool that slipped, an instrument that moved)",
    Reason.SAME_LOADS: "no pose was measured under two loads: flexibilities rest on geometry and "
    "load together",
    Reason.VERIFYING_FITTED: "{0} reading(s) to verify were fitted: too few others determine where "
    "their instrument stands, or their target sits",
    Reason.FRAME_FITTED: "the instrument's place was fitted to these poses: a turn of the whole "
    "arm, or another zero of joint 1, is not seen",
    Reason.FEW_NUMBERS: "only {0} numbers are left to judge by: measure more poses",
    Reason.NOTHING: "nothing is left that a further effect could explain",
    Reason.UNCONVERGED: "the fit did not converge",
    Reason.EFFECTS_MISSING: "to be added, with the share that each takes off what is left on poses "
    "left out of its fit: {0:shares}",
    Reason.EFFECTS_ACCUSED: "{0} is left to be added",
    Reason.STRUCTURE: "structure is left that no effect of the catalogue explains",
    Reason.FAR_OFF: "held-out poses are {0:.1f} times as far off as predicted",
    Reason.NOTHING_WEIGHS: "nothing that weighs hangs on the sensor: no centre of gravity can be "
    "found",
    Reason.NEGATIVE_MASS: "the load weighs {0:.3f} kg: the sensor's signs or axes are not those of "
    "a log (a mass at rest reads its weight, pointing down, in flange axes)",
    Reason.READINGS_DOWN: DOWN + "reading {0}",
    Reason.TOUCHES_DOWN: DOWN + "touch {0}",
    Reason.NOT_IDENTIFIABLE: "not identifiable from these poses: {0}",
    Reason.IDLE_LOADS: "loads that add nothing and need not be hung: {0:kg}",
    Reason.ONE_LOAD: "one load alone: compliance is found from the arm's own weight; a second load "
    "determines it better",
    Reason.SIGHT_UNKNOWN: "nobody said where the instrument stands: whether it sees the target was "
    "not looked at",
    Reason.DETOURS: "no straight way in joint space, go round: stops {0:ways}",
    Reason.FEW_POSES: "few poses to choose from: {0:rejected}",
    Reason.NO_STAMPS: "{0}: {1} of {2} messages have no stamp in their header; the time of "
    "recording stands in its place",
    Reason.NO_TARGET: "target_q: no topic has it, so that tracking cannot be observed",
    Reason.WRENCH_UNKNOWN: "{0}: left out; say what it measures with --wrench {1:or}",
    Reason.POSE_UNNAMED: "{0}: left out; name the tracker's topic with --topic pose=TOPIC",
    Reason.TAKEN_AS: "{0}: taken as {1}, its axes are those of {2!r}",
    Reason.EFFORT_UNKNOWN: "{0}: effort left out; where it is Nm (some drivers report A) say "
    "--effort-is-torque",
    Reason.NO_COMMON_TIME: "{0}: shares no time with {1}, left out",
    Reason.GAPS: "{0}: {1} gaps, the longest {2:.3g} s",
    Reason.UNCOVERED: "{0} of {1} rows left out: not covered by every topic",
    Reason.FRAME_TIMES: "timestamp is the frame's number over {0:g} Hz, not measured: a latency "
    "below {1:.0f} ms cannot be given",
    Reason.EPISODES: "{0} episodes in a row, {1:g} s between two",
    Reason.MIDDLE_ZERO: "a joint's zero is the middle of its calibrated range, not the model's",
    Reason.BEHIND_GEARS: "actual_current_as_torque is tau_J: measured behind the gears, without "
    "the motor's friction and inertia",
}


def note_text(note: Note, title: Callable[[str], str] = str) -> str:
    """Return a note as a sentence; ``title``: how a parameter or an effect is named in it."""
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


def calibration_text(found: Calibration, title: Callable[[str], str] = str) -> str:
    """Return a calibration in one sentence; ``title`` as in ``note_text``."""
    held = len(found.held_out_before.rows) > 0
    before, after = (
        (found.held_out_before, found.held_out_after) if held else (found.before, found.after)
    )
    where = "on poses that the fit never saw" if held else "on the fitted poses (none held out)"
    change = "rises" if after.rms > before.rms else "falls"
    text = (
        f"the error {change} from {1e3 * before.rms:.3f} to {1e3 * after.rms:.3f} mm rms {where}; "
        f"the fit leaves {1e3 * found.noise:.3f} mm a coordinate"
    )
    if np.isfinite(found.noise_floor):
        text += f" (instrument and arm alone: {1e3 * found.noise_floor:.3f} mm)"
    return (
        f"{text}; {'' if found.complete else 'not complete: '}{note_text(found.remaining, title)}"
    )


def short_text(found: PayloadCalibration | ToolCalibration) -> str:
    """Return what a short session found in one sentence."""
    return _payload(found) if isinstance(found, PayloadCalibration) else _tool(found)


def _payload(found: PayloadCalibration) -> str:
    for note in found.notes:
        if note.reason in (Reason.NOTHING_WEIGHS, Reason.NEGATIVE_MASS):
            return note_text(note)
    mass, *centre = found.estimates[:4]
    low, high = mass.interval
    return (
        f"the load weighs {mass.value:.3f} kg ({low:.3f} to {high:.3f}), its centre of gravity is "
        f"known to {1e3 * max(e.std for e in centre):.1f} mm (1 sigma)"
    )


def _tool(found: ToolCalibration) -> str:
    sure = float(np.linalg.norm([e.std for e in found.estimates]))
    if found.moved < SURE * sure:
        return (
            f"the tool's tip is where the cell says, within {1e3 * sure:.2f} mm (1 sigma of its "
            "place)"
        )
    return (
        f"the tool's tip sits {1e3 * found.moved:.2f} mm beside the cell's, known to "
        f"{1e3 * sure:.2f} mm (1 sigma)"
    )
