"""The session as the technician meets it: stop after stop, until every one is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.format import force, millimetres, point
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError, Where
from gapbridge.bridge.calibration.joints.joint_source import Stand, TypedJoints
from gapbridge.bridge.calibration.session.capture import Captured, capture
from gapbridge.bridge.calibration.session.pace import header
from gapbridge.bridge.calibration.session.positioning import Bringing
from gapbridge.bridge.calibration.session.prompt import Talk, Word
from gapbridge.bridge.calibration.session.reading import Taken
from gapbridge.bridge.calibration.session.reading_check import NOTHING, Foresight, Verdict
from gapbridge.bridge.calibration.session.revisit import look_back
from gapbridge.bridge.calibration.session.session import Book

Array = NDArray[np.float64]
SHAKY = 10.0  # times the instrument's sigma: samples that scatter more are doubted
SHAKIEST = 1e-4  # m: less than this is never doubted
SAME = 2e-4  # m: two readings this near to each other are the same


class Conversation:
    """One session at one terminal."""

    def __init__(
        self, talk: Talk, book: Book, bringing: Bringing, instrument: AnyInstrument,
        foresight: Foresight | None, sigma: float, samples: int,
    ) -> None:  # fmt: skip
        self.talk, self.book, self.bringing = talk, book, bringing
        self.instrument, self.foresight = instrument, foresight
        self.sigma, self._samples = sigma, samples

    def lead(self) -> None:
        """Go on until no stop is left. Raises Word where the person wants to end."""
        while (stop := self.book.next) is not None:
            try:
                self._put(self.book.stops[stop].station)
                self.bringing.mount(self.book.stops[stop].load)
                self.talk.say()
                self.talk.say(header(self.book, stop, self.bringing.minutes_per_load), "bold")
                self._stop(stop)
            except Word as word:
                self._word(word, stop)

    def _put(self, place: int) -> None:
        """Have the instrument where the plan has it: a place of its own, as after a knock."""
        if place != self.book.place:
            self.bringing.place(place)
            station = self.book.station + self._measured_here()
            self.book.add("moved", station=station, target=self.book.target, place=place)

    def _measured_here(self) -> bool:
        """Return whether anything was measured by this place of instrument and target."""
        book = self.book
        here = (book.station, book.target)
        return any((t.station, t.target - book.stops[t.stop].target) == here for t in book.taken)

    def _stop(self, stop: int) -> None:
        """Measure one stop, again and again until a reading of it is kept."""
        pose = self.book.stops[stop]
        stand = self.bringing.bring(pose)
        before: Array | None = None  # what was rejected last
        while True:
            taken, captured = self.measure(stop, stand)
            verdict = self.judge(taken, captured)
            if not verdict.doubted:
                self._keep(taken, verdict)
                return
            taken_again = before is not None and np.linalg.norm((taken.value - before)[:3]) < SAME
            chosen = self._doubt(verdict, bool(taken_again))
            if chosen:
                if chosen == "take" and verdict.instead is not None:
                    taken = replace(taken, value=verdict.instead)
                    verdict = self.judge(taken, captured)
                self._keep(replace(taken, doubted=chosen == "keep"), verdict)
                return
            self.book.add("rejected", stop=stop, value=taken.value, source=taken.source,
                          off=verdict.off, reasons=verdict.reasons)  # fmt: skip
            before = taken.value
            stand = self.bringing.bring(pose)

    def measure(
        self, stop: int, stand: Stand | None, again: bool = False
    ) -> tuple[Taken, Captured]:
        """Read the instrument until it gives a reading."""
        pose = self.book.stops[stop]
        while True:
            try:
                if self.instrument.manual or self.instrument.seats:
                    found = self._captured(stop, stand)
                else:
                    with self.talk.waiting(f"reading {self.instrument.name}"):
                        found = self._captured(stop, stand)
                break
            except ReadingError as error:
                self.talk.warn(str(error))
                if not self.instrument.manual:
                    self.talk.enter("  Enter to try again")
                    stand = self.bringing.bring(pose)
        at = found.stand
        before = self.book.taken[-1].q if self.book.taken else at.q
        approach = np.sign(np.where(np.abs(at.q - before) > 1e-4, at.q - before, 0.0))
        planned = np.where(pose.approach != 0.0, pose.approach, approach)
        return Taken(
            stop=stop, q=at.q, value=found.value, scatter=found.scatter, samples=found.samples,
            load=pose.load, station=self.book.station, target=pose.target + self.book.target,
            approach=planned if at.approach is None else at.approach, source=found.source,
            temperature=at.temperature, wrench=at.wrench, raw_wrench=at.raw_wrench, again=again,
        ), found  # fmt: skip

    def _captured(self, stop: int, stand: Stand | None) -> Captured:
        where = Where(stop + 1, self._samples, frozenset(self.book.used))
        return capture(
            self.instrument, self.bringing.joints, self.book.stops[stop], stand, where
        )  # fmt: skip

    def judge(self, taken: Taken, captured: Captured) -> Verdict:
        """Return whether a reading can be believed, by the readings so far and its own scatter."""
        if self.foresight is None:
            return NOTHING
        good = [t for t in self.book.taken if not t.doubted]
        kind = self.instrument.kind
        verdict = self.foresight.judge(
            self.book.readings(kind, good), self.book.readings(kind, [taken]),
            self.instrument.manual, isinstance(self.bringing.joints, TypedJoints),
        )  # fmt: skip
        limit = max(SHAKY * self.sigma, SHAKIEST)
        if captured.spread > limit:
            words = (
                f"the samples scatter by {millimetres(captured.spread)}: the tool swings, or the "
                "beam is disturbed"
            )
            return replace(verdict, doubted=True, reasons=(words, *verdict.reasons))
        return verdict

    def _keep(self, taken: Taken, verdict: Verdict) -> None:
        self.book.add("reading", **{**taken.entry(), "off": verdict.off})
        weighs = self.instrument.needs_wrench
        told = [f"  kept  {force(taken.raw_wrench) if weighs else point(taken.value)}"]
        if taken.samples > 1:
            told.append(f"mean of {taken.samples}, ±{millimetres(taken.scatter)}")
        if np.isfinite(verdict.off):
            told.append(
                f"{millimetres(verdict.off)} from where it was expected "
                f"(up to {millimetres(verdict.allowed)})"
            )
        if taken.doubted:
            told.append("doubtful")
        self.talk.say(" · ".join(told), "green" if not taken.doubted else "yellow")

    def _doubt(self, verdict: Verdict, same: bool) -> str:
        """Tell what looks wrong; returns ``""`` (measure again), ``take`` or ``keep``."""
        if verdict.off > verdict.allowed:
            self.talk.warn(
                f"{millimetres(verdict.off)} from where it was expected; a good reading is within "
                f"{millimetres(verdict.allowed)}"
            )
        for reason in verdict.reasons:
            self.talk.say(f"    {reason}", "yellow")
        if not verdict.reasons:
            self.talk.say(
                "    no plain reason: the instrument knocked? the target slipped? something in the "
                "beam, or touching the tool?", "yellow",
            )  # fmt: skip
        if same:
            self.talk.say(
                "    the same as the time before, so it is no slip: `back` measures an earlier "
                "pose again and tells what has moved", "yellow",
            )  # fmt: skip
        answers = {"": "measure this pose again"}
        if verdict.instead is not None:
            answers["take"] = f"take it as {point(verdict.instead)}"
        answers["keep"] = "keep it as it is, marked as doubtful"
        answers["back"] = "measure an earlier pose again: has the instrument or the target moved?"
        return self.talk.choose("  what now", answers)

    def _word(self, word: Word, stop: int) -> None:
        """Do what a word of the session asks for."""
        if word.word == "undo":
            self._undo()
        elif word.word == "skip":
            self.book.add("skip", stop=stop)
            self.talk.say(f"  stop {stop + 1} is left out")
        elif word.word == "back":
            look_back(self)
        elif word.word in ("moved", "slipped"):
            self.mark_moved(word.word)
        else:
            raise word

    def _undo(self) -> None:
        if not self.book.taken:
            self.talk.say("  nothing to take back")
            return
        last = self.book.taken[-1]
        self.book.add("undo", stop=last.stop)
        self.talk.say(f"  took back the reading of stop {last.stop + 1}")

    def mark_moved(self, what: str, since: int | None = None) -> None:
        """Begin a new place of the instrument, or of the target, from a reading on."""
        book = self.book
        if not self._measured_here():
            self.talk.say("  nothing has been measured from where it stands: it is that place")
            return
        station = book.station + (what == "moved")
        target = book.target + (what == "slipped")
        book.add("moved", station=station, target=target, since=since)
        if what == "moved":
            self.talk.say(f"  place {station + 1} of the instrument from here on; earlier readings "
                          "stay good")  # fmt: skip
        else:
            self.talk.say("  the target has a new place on the tool from here on; earlier readings "
                          "stay good")  # fmt: skip
