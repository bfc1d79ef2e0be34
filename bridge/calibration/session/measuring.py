"""Measures stop after stop: reads the instrument, checks the reading, and asks where in doubt."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gapbridge.bridge.calibration.format import force_text, millimetres, reading_text
from gapbridge.bridge.calibration.instruments.instrument import (
    AnyInstrument,
    ArmMovedError,
    ReadingError,
    ReadRequest,
)
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource, TypedJoints
from gapbridge.bridge.calibration.planning import REPEATABILITY
from gapbridge.bridge.calibration.session.positioning import AT_POSE, Positioning
from gapbridge.bridge.calibration.session.prompt import Prompt, SessionCommand
from gapbridge.bridge.calibration.session.reading_check import NOT_CHECKED, ReadingCheck, Verdict
from gapbridge.bridge.calibration.session.session import Reading, Session, stop_header
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError
from gapbridge.core.estimation.registration import register
from gapbridge.core.rotation import mean_rotation

SCATTER_FACTOR = 10.0  # times the instrument's sigma: scatter of the samples beyond which it asks
MIN_SCATTER = 1e-4  # m: less scatter is accepted
REVISITS = 3  # earlier poses that `back` measures again if the first of them has changed
SHIFT_FACTOR = 6.0  # times the noise of instrument and arm: a larger change of a reading is a move
MIN_SHIFT = 1.5e-4  # m, smallest change that counts as a move
DECISIVE_RATIO = 3.0  # of the rms residuals: instrument moved against target slipped
SAME_READING = 2e-4  # m: two readings nearer to each other are the same


@dataclass(frozen=True)
class CapturedReading:
    """An averaged reading with the state of the arm."""

    joint_sample: JointSample
    value: Array  # (k,) SI
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: one sample only
    spread: float  # m, 1 sigma of one coordinate of one sample; nan: as above
    samples: int
    source: str


def capture(
    instrument: AnyInstrument, joints: JointSource, pose: PlannedPose,
    joint_sample: JointSample | None, request: ReadRequest,
) -> CapturedReading:  # fmt: skip
    """Read the instrument. Raises ReadingError if it fails, ArmMovedError, LinkError.

    ``joint_sample`` None: the joints are sampled after the instrument was read.
    """
    with joints.watched():
        samples = instrument.read(request)
    if joint_sample is None:
        joint_sample = joints.sample_at_rest(pose)
    else:
        _require_unmoved(joints, joint_sample, samples.source)
    if instrument.needs_wrench and joint_sample.raw_wrench is None:
        raise LinkError("the controller sends no ft_raw_wrench, expected a force sensor's reading")
    values = samples.values
    if not np.isfinite(values).all():
        raise ReadingError("found a reading that is not finite")
    spread = float("nan")
    if len(values) > 1 and values.shape[1]:
        lengths = values[:, :3] if values.shape[1] >= 3 else values
        spread = float(np.sqrt(lengths.var(axis=0, ddof=1).mean()))
    std = spread / np.sqrt(len(values))
    return CapturedReading(joint_sample, mean(values), std, spread, len(values), samples.source)


def _require_unmoved(joints: JointSource, sample: JointSample, source: str) -> None:
    """Raise ArmMovedError if the arm has moved since the sample, or that is unknown."""
    try:
        unmoved = joints.unmoved_since(sample)
    except ReadingError as error:
        raise ArmMovedError(str(error), source) from error
    if not unmoved:
        raise ArmMovedError("the arm moved while it was measured", source)


def mean(values: Array) -> Array:
    """Return the mean (k,) of samples (M, k); of a pose (k = 6) the mean rotation."""
    average: Array = np.asarray(values.mean(axis=0), dtype=float)
    if values.shape[1] == 6:
        average[3:] = mean_rotation(values[:, 3:])
    return average


@dataclass(frozen=True)
class Revisit:
    """An earlier pose, measured again."""

    now: Reading
    shift: Array  # (3,) or (k,) m, change of the reading, motion of the arm subtracted


class Measuring:
    """Takes the readings of a session, guided by prompts at the terminal."""

    def __init__(
        self, prompt: Prompt, session: Session, positioning: Positioning, instrument: AnyInstrument,
        reading_check: ReadingCheck | None, sigma: float, samples: int,
    ) -> None:  # fmt: skip
        self.prompt, self.session, self.positioning = prompt, session, positioning
        self.instrument, self.reading_check = instrument, reading_check
        self.sigma, self._samples = sigma, samples

    def run(self) -> None:
        """Measure all open stops. Raises SessionCommand if the operator quits, LinkError."""
        while (stop := self.session.next_stop) is not None:
            try:
                self._place_instrument(self.session.stops[stop].station)
                self.positioning.mount_load(self.session.stops[stop].load)
                self.prompt.say()
                self.prompt.say(
                    stop_header(self.session, stop, self.positioning.minutes_per_load), "bold"
                )
                self._measure_stop(stop)
            except SessionCommand as command:
                self._run_command(command, stop)

    def _place_instrument(self, place: int) -> None:
        """Ask for the instrument to be moved to a planned position; it gets a new station."""
        if place != self.session.place:
            self.positioning.place_instrument(place)
            station = self.session.station + self._measured_here()
            self.session.add("moved", station=station, target=self.session.target, place=place)

    def _measured_here(self) -> bool:
        """Return whether any reading has the present station and target position."""
        session = self.session
        present = (session.station, session.target)
        return any(
            (r.station, r.target - session.stops[r.stop].target) == present
            for r in session.accepted
        )

    def _measure_stop(self, stop: int) -> None:
        """Measure one stop until a reading of it is accepted."""
        pose = self.session.stops[stop]
        joint_sample = self.positioning.reach(pose)
        rejected: Array | None = None  # (k,) the last rejected value
        while True:
            reading, captured = self.measure(stop, joint_sample)
            verdict = self.check(reading, captured)
            if not verdict.implausible:
                self._keep(reading, verdict)
                return
            change = np.inf if rejected is None else np.linalg.norm((reading.value - rejected)[:3])
            answer = self._ask_operator(verdict, bool(change < SAME_READING))
            if answer:
                if answer == "take" and verdict.corrected is not None:
                    reading = replace(reading, value=verdict.corrected)
                    verdict = self.check(reading, captured)
                self._keep(replace(reading, doubted=answer == "keep"), verdict)
                return
            self.session.add("rejected", stop=stop, value=reading.value, source=reading.source,
                          off=verdict.deviation, reasons=verdict.explanations)  # fmt: skip
            rejected = reading.value
            joint_sample = self.positioning.reach(pose)

    def measure(
        self, stop: int, joint_sample: JointSample | None, again: bool = False
    ) -> tuple[Reading, CapturedReading]:
        """Read the instrument until it gives a valid reading; ``again``: of an earlier stop."""
        pose = self.session.stops[stop]
        while True:
            try:
                if self.instrument.manual or self.instrument.contact:
                    captured = self._capture(stop, joint_sample)
                else:
                    with self.prompt.waiting(f"reading {self.instrument.name}"):
                        captured = self._capture(stop, joint_sample)
                self._require_another_contact(pose, captured.joint_sample.q)
                break
            except ReadingError as error:
                self.prompt.warn(str(error))
                if isinstance(error, ArmMovedError):  # of elsewhere: its row is not read again
                    self.session.add(
                        "rejected", stop=stop, source=error.source, reasons=[str(error)]
                    )
                if not self.instrument.manual:
                    self.prompt.enter("  Enter to try again")
                if not self.instrument.manual or isinstance(error, ArmMovedError):
                    joint_sample = self.positioning.reach(pose)
        arm = captured.joint_sample
        before = self.session.accepted[-1].q if self.session.accepted else arm.q
        approach = np.sign(np.where(np.abs(arm.q - before) > 1e-4, arm.q - before, 0.0))
        planned = np.where(pose.approach != 0.0, pose.approach, approach)
        return Reading(
            stop=stop, q=arm.q, value=captured.value, scatter=captured.scatter,
            samples=captured.samples, source=captured.source, load=pose.load,
            station=self.session.station, target=pose.target + self.session.target,
            approach=planned if arm.approach is None else arm.approach,
            temperature=arm.temperature, wrench=arm.wrench, raw_wrench=arm.raw_wrench, again=again,
        ), captured  # fmt: skip

    def _capture(self, stop: int, joint_sample: JointSample | None) -> CapturedReading:
        request = ReadRequest(stop + 1, self._samples, frozenset(self.session.used_sources))
        pose, joints = self.session.stops[stop], self.positioning.joints
        return capture(self.instrument, joints, pose, joint_sample, request)

    def _require_another_contact(self, pose: PlannedPose, q: Array) -> None:
        """Raise ReadingError where the arm is still in contact as for another pose.

        Enter pressed twice would count one touch as two, with too small a standard deviation.
        """
        for other in self.session.accepted if self.instrument.contact else ():
            same = np.abs(other.q - q).max() < AT_POSE
            if same and self.session.stops[other.stop].number != pose.number:
                raise ReadingError(
                    f"found the joints of stop {other.stop + 1}, expected another orientation"
                )

    def check(self, reading: Reading, captured: CapturedReading) -> Verdict:
        """Check a reading against the readings so far, and the scatter of its samples."""
        if self.reading_check is None:
            return NOT_CHECKED
        good = [r for r in self.session.accepted if not r.doubted]
        kind = self.instrument.kind
        verdict = self.reading_check.check(
            self.session.readings(kind, good), self.session.readings(kind, [reading]),
            self.instrument.manual, isinstance(self.positioning.joints, TypedJoints),
        )  # fmt: skip
        limit = max(SCATTER_FACTOR * self.sigma, MIN_SCATTER)
        if captured.spread > limit:
            reason = (
                f"the samples scatter by {millimetres(captured.spread)}: the tool swings, or the "
                "beam is disturbed"
            )
            return replace(verdict, implausible=True, explanations=(reason, *verdict.explanations))
        return verdict

    def _keep(self, reading: Reading, verdict: Verdict) -> None:
        self.session.add("reading", **{**reading.entry(), "off": verdict.deviation})
        sensor = self.instrument.needs_wrench
        value = force_text(reading.raw_wrench) if sensor else reading_text(reading.value)
        parts = [f"  kept  {value}"]
        if reading.samples > 1:
            parts.append(f"mean of {reading.samples}, ±{millimetres(reading.scatter)}")
        if np.isfinite(verdict.deviation):
            parts.append(
                f"{millimetres(verdict.deviation)} from where it was expected "
                f"(up to {millimetres(verdict.limit)})"
            )
        if reading.doubted:
            parts.append("doubtful")
        self.prompt.say(" · ".join(parts), "green" if not reading.doubted else "yellow")

    def _ask_operator(self, verdict: Verdict, same: bool) -> str:
        """Report an implausible reading; return ``""`` (measure again), ``take`` or ``keep``.

        Raises SessionCommand where the operator chooses ``back``.
        """
        if verdict.deviation > verdict.limit == 0.0:  # out of the instrument's range
            self.prompt.warn("this instrument cannot give such a reading")
        elif verdict.deviation > verdict.limit:
            self.prompt.warn(
                f"{millimetres(verdict.deviation)} from where it was expected; a good reading is "
                f"within {millimetres(verdict.limit)}"
            )
        for explanation in verdict.explanations:
            self.prompt.say(f"    {explanation}", "yellow")
        if not verdict.explanations:
            self.prompt.say(
                "    no simple explanation: the instrument knocked? the target slipped? something "
                "in the beam, or touching the tool?", "yellow",
            )  # fmt: skip
        if same:
            self.prompt.say(
                "    the same as before, so it is no typing error: `back` measures an earlier "
                "pose again and reports what has moved", "yellow",
            )  # fmt: skip
        answers = {"": "measure this pose again"}
        if verdict.corrected is not None:
            answers["take"] = f"take it as {reading_text(verdict.corrected)}"
        answers["keep"] = "keep it as it is, marked as doubtful"
        answers["back"] = "measure an earlier pose again: has the instrument or the target moved?"
        answer = self.prompt.choose("  what now", answers)
        if answer == "back":  # typed in part: `back` itself is a command already
            raise SessionCommand(answer)
        return answer

    def _run_command(self, command: SessionCommand, stop: int) -> None:
        """Execute a command of the session at a stop."""
        if command.name == "undo":
            self.prompt.say(f"  {self.session.undo()}")
        elif command.name == "skip":
            self.session.add("skip", stop=stop)
            self.prompt.say(f"  stop {stop + 1} is skipped")
        elif command.name == "back":
            self._revisit_earlier()
        elif command.name in ("moved", "slipped"):
            self.mark_moved(command.name)
        else:
            raise command

    def mark_moved(self, what: str, since: int | None = None) -> None:
        """Start a new station (``moved``) or target (``slipped``) from reading ``since`` on."""
        session = self.session
        if not self._measured_here():
            self.prompt.say("  no reading was taken at the present position: it needs no new one")
            return
        if self.reading_check is None:  # a short session, whose fit knows one place only
            self.prompt.warn(
                "all readings of this session have to be of one place: put it back and measure "
                f"again what was read since, or begin a new session; `{what}` is not noted"
            )
            return
        station = session.station + (what == "moved")
        target = session.target + (what == "slipped")
        session.add("moved", station=station, target=target, since=since)
        if what == "moved":
            self.prompt.say(
                f"  place {station + 1} of the instrument from here on; earlier readings are kept"
            )
        else:
            self.prompt.say(
                "  the target has a new place on the tool from here on; earlier readings are kept"
            )

    # -- `back`: earlier poses are measured again ------------------------------------------------

    def _revisit_earlier(self) -> None:
        """Measure an earlier pose again, further ones if it has changed, and report what moved."""
        prompt, session = self.prompt, self.session
        earlier = self._comparable_readings()
        if self.reading_check is None or not self.reading_check.compares_readings or not earlier:
            prompt.say("  no earlier pose to measure again with this load, place and instrument")
            return
        limit = max(SHIFT_FACTOR * float(np.hypot(self.sigma, REPEATABILITY)), MIN_SHIFT)
        first = len(session.accepted)
        revisits: list[Revisit] = []
        for before in earlier[:REVISITS]:
            prompt.say(f"  back to stop {before.stop + 1}", "bold")
            revisits.append(self._revisit(before))
            shift = float(np.linalg.norm(revisits[-1].shift))
            if shift < limit:
                break
            prompt.warn(
                f"the reading of stop {before.stop + 1} has changed by {millimetres(shift)}"
            )
        if shift < limit:
            prompt.say(
                f"  as before, within {millimetres(limit)}: instrument and target have not "
                "moved; measure the doubtful pose again"
            )
            return
        self._ask_what_moved(revisits, first)

    def _comparable_readings(self) -> list[Reading]:
        """Return one good reading per stop with the present station and load, newest first."""
        session, comparable, stops = self.session, [], set()
        for reading in reversed(session.accepted):
            same = reading.station == session.station and reading.load == session.mounted
            if same and not reading.doubted and reading.stop not in stops:
                stops.add(reading.stop)
                comparable.append(reading)
        return comparable

    def _revisit(self, before: Reading) -> Revisit:
        session = self.session
        pose = session.stops[before.stop]
        now, _ = self.measure(before.stop, self.positioning.reach(pose), again=True)
        session.add("reading", **now.entry())
        kind = self.instrument.kind
        assert self.reading_check is not None
        shift = self.reading_check.shift(
            session.readings(kind, [before]), session.readings(kind, [now]),
            session.readings(kind, [r for r in session.accepted[:-1] if not r.doubted]),
        )  # fmt: skip
        return Revisit(now, shift)

    def _ask_what_moved(self, revisits: list[Revisit], first: int) -> None:
        """Report what has moved, ask for confirmation, and start a new station or target."""
        prompt = self.prompt
        residuals = self._motion_residuals(revisits)
        answers = {"moved": "the instrument was knocked or moved: it has a new place from here on",
                   "slipped": "the target slipped on the tool: it has a new place from here on",
                   "keep": "neither: continue without a change"}  # fmt: skip
        likely = ""
        if residuals and min(residuals.values()) * DECISIVE_RATIO < max(residuals.values()):
            likely = min(residuals, key=lambda name: residuals[name])
            what = "the instrument has moved" if likely == "moved" else "the target has slipped"
            prompt.say(
                f"  {what}: that leaves {millimetres(residuals[likely])} unexplained, "
                f"the other explanation {millimetres(max(residuals.values()))}"
            )
        else:
            prompt.say("  these poses do not show whether the instrument or the target has moved")
        order = [likely, *(k for k in answers if k != likely)] if likely else list(answers)
        answer = prompt.choose("  which", {k: answers[k] for k in order})
        if answer != "keep":
            self.mark_moved(answer, since=first)

    def _motion_residuals(self, revisits: list[Revisit]) -> dict[str, float]:
        """Return rms residuals, m, of a rigid motion and of a shift in tool axes; {}: too few."""
        if len(revisits) < REVISITS or len(revisits[0].shift) < 3:
            return {}
        assert self.reading_check is not None
        poses = self.reading_check.poses(self.session.readings(
            self.instrument.kind, [r.now for r in revisits]
        ))  # fmt: skip
        shift = np.array([r.shift[:3] for r in revisits])
        tcp = poses.position
        frame = register(tcp + shift, tcp)
        rigid = tcp + shift - (tcp @ frame.rotation.T + frame.position)
        in_tool = np.einsum("nji,nj->ni", poses.rotation, shift)
        slip = in_tool - in_tool.mean(axis=0)
        count = shift.size  # a rigid motion has six degrees of freedom, a slip three
        return {
            "moved": float(np.sqrt(np.sum(rigid**2) / (count - 6))),
            "slipped": float(np.sqrt(np.sum(slip**2) / (count - 3))),
        }
