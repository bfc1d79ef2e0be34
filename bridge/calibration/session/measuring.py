"""The session as the technician meets it: stop after stop, until every one is measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gapbridge.bridge.calibration.format import force, millimetres, point
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError, Where
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource, TypedJoints
from gapbridge.bridge.calibration.session.positioning import Positioning
from gapbridge.bridge.calibration.session.prompt import Prompt, SessionCommand
from gapbridge.bridge.calibration.session.reading_check import NOTHING, ReadingCheck, Verdict
from gapbridge.bridge.calibration.session.session import Reading, Session, header
from gapbridge.core.arrays import Array
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError
from gapbridge.core.estimation.registration import register
from gapbridge.core.rotation import mean_rotation

SHAKY = 10.0  # times the instrument's sigma: samples that scatter more are doubted
SHAKIEST = 1e-4  # m: less than this is never doubted
REVISITED = 3  # poses measured once more where the first of them has changed
NOISES = 6.0  # of instrument and arm: two readings of a pose differ by less
LEAST = 1.5e-4  # m
REPEATABILITY = 5e-5  # m, 1 sigma of one coordinate
PLAINER = 3.0  # times: the residual by the other story
SAME = 2e-4  # m: two readings this near to each other are the same


@dataclass(frozen=True)
class Captured:
    """An averaged reading and where the arm stood meanwhile."""

    stand: JointSample
    value: Array  # (k,) SI
    scatter: float  # m, 1 sigma of one coordinate of the mean; nan: one sample gives none
    spread: float  # m, 1 sigma of one coordinate of one sample; nan: as above
    samples: int
    source: str


def capture(
    instrument: AnyInstrument, joints: JointSource, pose: PlannedPose, stand: JointSample | None,
    where: Where,
) -> Captured:  # fmt: skip
    """Read the instrument. Raises ReadingError where it fails or the arm moved meanwhile.

    ``stand`` None: the arm stands where it does once the instrument has been read.
    """
    found = instrument.read(where)
    if stand is None:
        stand = joints.stand(pose)
    elif not joints.still(stand):
        raise ReadingError("the arm moved while it was measured")
    if instrument.needs_wrench and stand.raw_wrench is None:
        raise LinkError("the controller sends no ft_raw_wrench, expected a force sensor's reading")
    values = found.values
    if not np.isfinite(values).all():
        raise ReadingError("found a reading that is not finite")
    spread = float("nan")
    if len(values) > 1 and values.shape[1]:
        lengths = values[:, :3] if values.shape[1] >= 3 else values
        spread = float(np.sqrt(lengths.var(axis=0, ddof=1).mean()))
    return Captured(
        stand, mean(values), spread / np.sqrt(len(values)), spread, len(values), found.source
    )


def mean(values: Array) -> Array:
    """Return the mean (k,) of samples (M, k)."""
    found: Array = np.asarray(values.mean(axis=0), dtype=float)
    if values.shape[1] == 6:
        found[3:] = mean_rotation(values[:, 3:])
    return found


@dataclass(frozen=True)
class Revisit:
    """One pose, before and now."""

    before: Reading
    now: Reading
    q: Array  # (n,)
    shift: Array  # (3,) or (k,) m, how far the reading has gone, the arm's own motion taken off


class Measuring:
    """One session at one terminal."""

    def __init__(
        self, prompt: Prompt, session: Session, positioning: Positioning, instrument: AnyInstrument,
        reading_check: ReadingCheck | None, sigma: float, samples: int,
    ) -> None:  # fmt: skip
        self.prompt, self.session, self.positioning = prompt, session, positioning
        self.instrument, self.reading_check = instrument, reading_check
        self.sigma, self._samples = sigma, samples

    def lead(self) -> None:
        """Go on until no stop is left. Raises SessionCommand where the person wants to end."""
        while (stop := self.session.next) is not None:
            try:
                self._put(self.session.stops[stop].station)
                self.positioning.mount(self.session.stops[stop].load)
                self.prompt.say()
                self.prompt.say(
                    header(self.session, stop, self.positioning.minutes_per_load), "bold"
                )
                self._stop(stop)
            except SessionCommand as command:
                self._run_command(command, stop)

    def _put(self, place: int) -> None:
        """Have the instrument where the plan has it: a place of its own, as after a knock."""
        if place != self.session.place:
            self.positioning.place(place)
            station = self.session.station + self._measured_here()
            self.session.add("moved", station=station, target=self.session.target, place=place)

    def _measured_here(self) -> bool:
        """Return whether anything was measured by this place of instrument and target."""
        session = self.session
        here = (session.station, session.target)
        return any(
            (t.station, t.target - session.stops[t.stop].target) == here for t in session.taken
        )

    def _stop(self, stop: int) -> None:
        """Measure one stop, again and again until a reading of it is kept."""
        pose = self.session.stops[stop]
        stand = self.positioning.bring(pose)
        before: Array | None = None  # what was rejected last
        while True:
            taken, captured = self.measure(stop, stand)
            verdict = self.judge(taken, captured)
            if not verdict.doubted:
                self._keep(taken, verdict)
                return
            taken_again = before is not None and np.linalg.norm((taken.value - before)[:3]) < SAME
            chosen = self._resolve(verdict, bool(taken_again))
            if chosen:
                if chosen == "take" and verdict.instead is not None:
                    taken = replace(taken, value=verdict.instead)
                    verdict = self.judge(taken, captured)
                self._keep(replace(taken, doubted=chosen == "keep"), verdict)
                return
            self.session.add("rejected", stop=stop, value=taken.value, source=taken.source,
                          off=verdict.off, reasons=verdict.reasons)  # fmt: skip
            before = taken.value
            stand = self.positioning.bring(pose)

    def measure(
        self, stop: int, stand: JointSample | None, again: bool = False
    ) -> tuple[Reading, Captured]:
        """Read the instrument until it gives a reading."""
        pose = self.session.stops[stop]
        while True:
            try:
                if self.instrument.manual or self.instrument.seats:
                    found = self._captured(stop, stand)
                else:
                    with self.prompt.waiting(f"reading {self.instrument.name}"):
                        found = self._captured(stop, stand)
                break
            except ReadingError as error:
                self.prompt.warn(str(error))
                if not self.instrument.manual:
                    self.prompt.enter("  Enter to try again")
                    stand = self.positioning.bring(pose)
        at = found.stand
        before = self.session.taken[-1].q if self.session.taken else at.q
        approach = np.sign(np.where(np.abs(at.q - before) > 1e-4, at.q - before, 0.0))
        planned = np.where(pose.approach != 0.0, pose.approach, approach)
        return Reading(
            stop=stop, q=at.q, value=found.value, scatter=found.scatter, samples=found.samples,
            load=pose.load, station=self.session.station, target=pose.target + self.session.target,
            approach=planned if at.approach is None else at.approach, source=found.source,
            temperature=at.temperature, wrench=at.wrench, raw_wrench=at.raw_wrench, again=again,
        ), found  # fmt: skip

    def _captured(self, stop: int, stand: JointSample | None) -> Captured:
        where = Where(stop + 1, self._samples, frozenset(self.session.used))
        return capture(
            self.instrument, self.positioning.joints, self.session.stops[stop], stand, where
        )  # fmt: skip

    def judge(self, taken: Reading, captured: Captured) -> Verdict:
        """Return whether a reading can be believed, by the readings so far and its own scatter."""
        if self.reading_check is None:
            return NOTHING
        good = [t for t in self.session.taken if not t.doubted]
        kind = self.instrument.kind
        verdict = self.reading_check.judge(
            self.session.readings(kind, good), self.session.readings(kind, [taken]),
            self.instrument.manual, isinstance(self.positioning.joints, TypedJoints),
        )  # fmt: skip
        limit = max(SHAKY * self.sigma, SHAKIEST)
        if captured.spread > limit:
            reason = (
                f"the samples scatter by {millimetres(captured.spread)}: the tool swings, or the "
                "beam is disturbed"
            )
            return replace(verdict, doubted=True, reasons=(reason, *verdict.reasons))
        return verdict

    def _keep(self, taken: Reading, verdict: Verdict) -> None:
        self.session.add("reading", **{**taken.entry(), "off": verdict.off})
        weighs = self.instrument.needs_wrench
        parts = [f"  kept  {force(taken.raw_wrench) if weighs else point(taken.value)}"]
        if taken.samples > 1:
            parts.append(f"mean of {taken.samples}, ±{millimetres(taken.scatter)}")
        if np.isfinite(verdict.off):
            parts.append(
                f"{millimetres(verdict.off)} from where it was expected "
                f"(up to {millimetres(verdict.allowed)})"
            )
        if taken.doubted:
            parts.append("doubtful")
        self.prompt.say(" · ".join(parts), "green" if not taken.doubted else "yellow")

    def _resolve(self, verdict: Verdict, same: bool) -> str:
        """Report what looks wrong; returns ``""`` (measure again), ``take`` or ``keep``."""
        if verdict.off > verdict.allowed == 0.0:  # no place of it can be right
            self.prompt.warn("this instrument cannot give such a reading")
        elif verdict.off > verdict.allowed:
            self.prompt.warn(
                f"{millimetres(verdict.off)} from where it was expected; a good reading is within "
                f"{millimetres(verdict.allowed)}"
            )
        for reason in verdict.reasons:
            self.prompt.say(f"    {reason}", "yellow")
        if not verdict.reasons:
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
        if verdict.instead is not None:
            answers["take"] = f"take it as {point(verdict.instead)}"
        answers["keep"] = "keep it as it is, marked as doubtful"
        answers["back"] = "measure an earlier pose again: has the instrument or the target moved?"
        return self.prompt.choose("  what now", answers)

    def _run_command(self, command: SessionCommand, stop: int) -> None:
        """Do what a command of the session asks for."""
        if command.name == "undo":
            self._undo()
        elif command.name == "skip":
            self.session.add("skip", stop=stop)
            self.prompt.say(f"  stop {stop + 1} is skipped")
        elif command.name == "back":
            self._look_back()
        elif command.name in ("moved", "slipped"):
            self.mark_moved(command.name)
        else:
            raise command

    def _undo(self) -> None:
        if not self.session.taken:
            self.prompt.say("  no reading to discard")
            return
        last = self.session.taken[-1]
        self.session.add("undo", stop=last.stop)
        self.prompt.say(f"  discarded the reading of stop {last.stop + 1}")

    def mark_moved(self, what: str, since: int | None = None) -> None:
        """Begin a new place of the instrument, or of the target, from a reading on."""
        session = self.session
        if not self._measured_here():
            self.prompt.say("  nothing has been measured from where it stands: it is that place")
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

    # -- `back`: earlier poses measured once more ------------------------------------------------

    def _look_back(self) -> None:
        """Measure an earlier pose again, further ones where it has changed, and say what moved."""
        prompt, session = self.prompt, self.session
        earlier = self._earlier()
        if self.reading_check is None or not self.reading_check.compares or not earlier:
            prompt.say("  no earlier pose to go back to with this load, place and instrument")
            return
        limit = max(NOISES * float(np.hypot(self.sigma, REPEATABILITY)), LEAST)
        first = len(session.taken)
        seen: list[Revisit] = []
        for before in earlier[:REVISITED]:
            prompt.say(f"  back to stop {before.stop + 1}", "bold")
            seen.append(self._once_more(before))
            off = float(np.linalg.norm(seen[-1].shift))
            if off < limit:
                break
            prompt.warn(
                f"stop {before.stop + 1} now reads {millimetres(off)} beside what it read before"
            )
        if float(np.linalg.norm(seen[-1].shift)) < limit:
            prompt.say(
                f"  as before, within {millimetres(limit)}: instrument and target have not "
                "moved; measure the doubtful pose again"
            )
            return
        self._decide(seen, limit, first)

    def _earlier(self) -> list[Reading]:
        """Return good readings of different stops with what is mounted now, the newest first."""
        session, found, stops = self.session, [], set()
        for taken in reversed(session.taken):
            same = taken.station == session.station and taken.load == session.mounted
            if same and not taken.doubted and taken.stop not in stops:
                stops.add(taken.stop)
                found.append(taken)
        return found

    def _once_more(self, before: Reading) -> Revisit:
        session = self.session
        pose = session.stops[before.stop]
        now, _ = self.measure(before.stop, self.positioning.bring(pose), again=True)
        session.add("reading", **now.entry())
        kind = self.instrument.kind
        assert self.reading_check is not None
        shift = self.reading_check.shift(
            session.readings(kind, [before]), session.readings(kind, [now]),
            session.readings(kind, [t for t in session.taken[:-1] if not t.doubted]),
        )  # fmt: skip
        return Revisit(before, now, before.q, shift)

    def _decide(self, seen: list[Revisit], limit: float, first: int) -> None:
        """Say what has moved, have the person agree, and begin a new place."""
        prompt = self.prompt
        stories = self._stories(seen)
        answers = {"moved": "the instrument was knocked or moved: it has a new place from here on",
                   "slipped": "the target slipped on the tool: it has a new place from here on",
                   "keep": "neither: go on as if nothing had happened"}  # fmt: skip
        likely = ""
        if stories and min(stories.values()) * PLAINER < max(stories.values()):
            likely = min(stories, key=lambda story: stories[story])
            what = "the instrument has moved" if likely == "moved" else "the target has slipped"
            prompt.say(
                f"  {what}: that leaves {millimetres(stories[likely])} unexplained, "
                f"the other explanation {millimetres(max(stories.values()))}"
            )
        else:
            prompt.say(
                "  these poses do not show whether instrument or target has moved; you may know"
            )
        order = [likely, *(k for k in answers if k != likely)] if likely else list(answers)
        chosen = prompt.choose("  which", {k: answers[k] for k in order})
        if chosen != "keep":
            self.mark_moved(chosen, since=first)

    def _stories(self, seen: list[Revisit]) -> dict[str, float]:
        """Return the rms residual of each story, m: a rigid motion, or a shift in tool axes."""
        if len(seen) < REVISITED or len(seen[0].shift) < 3:
            return {}
        assert self.reading_check is not None
        poses = self.reading_check.poses(self.session.readings(
            self.instrument.kind, [a.now for a in seen]
        ))  # fmt: skip
        shift = np.array([a.shift[:3] for a in seen])
        there = poses.position
        frame = register(there + shift, there)
        rigid = there + shift - (there @ frame.rotation.T + frame.position)
        in_tool = np.einsum("nji,nj->ni", poses.rotation, shift)
        slip = in_tool - in_tool.mean(axis=0)
        count = shift.size  # degrees of freedom: six are spent on a motion, three on a slip
        return {
            "moved": float(np.sqrt(np.sum(rigid**2) / (count - 6))),
            "slipped": float(np.sqrt(np.sum(slip**2) / (count - 3))),
        }
