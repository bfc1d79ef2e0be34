"""The arm and its load, brought to where the next reading is taken."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gapbridge.bridge.calibration.format import degrees, load_text
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError
from gapbridge.bridge.calibration.joints.joint_source import JointSource, PlannedJoints, Stand
from gapbridge.bridge.calibration.session.prompt import Talk
from gapbridge.bridge.calibration.session.route import route
from gapbridge.bridge.calibration.session.session import Book
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import RunError

Array = NDArray[np.float64]
FAR = np.radians(3.0)  # an arm farther from the pose than this is asked about
THERE = 2e-3  # rad: an arm this near need not be driven
HEAVY = 0.05  # kg, and share: the controller's payload may differ from the plan's by as much
PULL = 12.0  # N at a tool that nothing touches


class Bringing:
    """Loads mounted by people; the arm jogged by them, or driven after their yes.

    ``clear`` tells for joints (N, n) whether they are free of what the cell names.
    """

    def __init__(
        self, talk: Talk, book: Book, joints: JointSource, instrument: AnyInstrument,
        clear: Callable[[Array], Array], settings: CalibrationSettings,
    ) -> None:  # fmt: skip
        self.talk, self.book, self.joints = talk, book, joints
        self.minutes_per_load = settings.minutes_per_load
        self._instrument, self._clear, self._speed = instrument, clear, settings.speed
        self._places = [settings.instrument_at or [], *settings.further_places]
        self._asked: int | None = None  # load for which driving was asked about
        self._driven = False
        self._warned: set[int] = set()

    def place(self, number: int) -> None:
        """Have the instrument carried to one of its planned places."""
        at = ", ".join(f"{v:g}" for v in self._places[number]) if self._places[number:] else "?"
        self.talk.say()
        self.talk.say(
            f"place {number + 1} · {self._instrument.stands} at about ({at}) m in base",
            "bold cyan",
        )
        self.talk.enter("  Enter when it stands there")

    def mount(self, load: int) -> None:
        """Have a load mounted, and ask whether the arm may be driven with it."""
        if load != self.book.mounted:
            self._hang(load)
        if self.joints.drives and self._asked != load:
            left = sum(p.load == load for p in self.book.stops)
            self.talk.say()
            self._driven = self.talk.confirm(
                f"The arm will be driven to {left} poses with load {load + 1}, at most "
                f"{self._speed:g} rad/s. Keep clear, a hand at the stop button. Drive it?"
            )
            if not self._driven:
                self.talk.say("  not driven: jog it, as the stops are told")
            self._asked = load

    def _hang(self, load: int) -> None:
        assert self.book.plan is not None
        what = self.book.plan.loads[load]
        self.talk.say()
        self.talk.say(f"load {load + 1} · {load_text(what)}", "bold cyan")
        if self._instrument.needs_wrench:
            self.talk.say("  it hangs on the flange, and nothing touches it?")
        else:
            self.talk.say("  hang it on the flange, and tell the controller its mass and centre")
        self.talk.enter("  Enter when it hangs there")
        self.book.add("mounted", load=load)

    def bring(self, pose: PlannedPose) -> Stand | None:
        """Return where the arm rests, once it does so at the pose.

        None where the instrument has it seated by hand afterwards.
        """
        if self._driven and not self._there(pose):
            self._drive(pose)
        if not self._driven:
            self.talk.say(f"  {degrees(pose.q)}")
        if self._instrument.seats:
            return None
        stand = self._rested(pose)
        self._look_at_load(pose, stand)
        return stand

    def _drive(self, pose: PlannedPose) -> None:
        """Move the arm to the pose; a person says whether to go on where a move broke off."""
        via = self._way(pose)
        while via is not None:
            try:
                with self.talk.waiting("driving"):
                    self.joints.drive(pose, via)
            except RunError as error:
                self.talk.warn(str(error))
                if self.talk.confirm("  Drive on from where it stands?"):
                    via = self._way(pose)
                    continue
                self.talk.say("  jog it to this pose, or `quit` and look at the arm")
                self._driven = False
                self._asked = None
            return

    def _there(self, pose: PlannedPose) -> bool:
        now = self.joints.now()
        return now is not None and bool(np.abs(now - pose.q).max() < THERE)

    def _way(self, pose: PlannedPose) -> list[Array] | None:
        """Return the poses to go by, free of what the cell names; None: no way is known."""
        begin = self.joints.now()
        if begin is None:
            return None
        known = [t.q for t in self.book.taken] + [p.q for p in self.book.stops]
        via = route(self._clear, begin, pose.q, known)
        if via is None:
            self.talk.warn("no way to this pose is known to be free: jog the arm there, or `skip`")
            self.talk.say(f"  {degrees(pose.q)}")
        elif via:
            self.talk.say(
                f"  going round by {len(via)} other pose{'s'[: len(via) > 1]} of the plan"
            )
        return via

    def _rested(self, pose: PlannedPose) -> Stand:
        while True:
            try:
                if not self.joints.watches:
                    if isinstance(self.joints, PlannedJoints) and not self._instrument.waits:
                        self.talk.enter("  Enter when it stands there")
                    return self.joints.stand(pose)
                found = self.joints.arrived(pose)
                if found is None:
                    found = self._jogged(pose)
                if found is not None:
                    return found
            except ReadingError as error:
                self.talk.warn(str(error))

    def _jogged(self, pose: PlannedPose) -> Stand | None:
        """Wait until the arm rests at the pose, or a person says that it stands well."""
        question = "  measured as soon as it rests there (Enter: where it is now)"
        heard = self.talk.ask_unless(question, lambda: self.joints.arrived(pose))
        if isinstance(heard, Stand):
            return heard
        if heard:
            self.talk.say(f"  found {heard!r}, expected Enter, or a word of the session (`?`)")
            return None
        now = self.joints.now()
        if now is None:
            return None
        apart = np.abs(now - pose.q)
        if apart.max() > FAR:
            joint = int(apart.argmax())
            far = f"  J{joint + 1} is {np.degrees(apart[joint]):.1f}° away."
            if not self.talk.confirm(f"{far} Measure here all the same?"):
                return None
        return self.joints.stand(pose)

    def _look_at_load(self, pose: PlannedPose, stand: Stand) -> None:
        """Tell where the controller believes in another load, or feels a pull."""
        assert self.book.plan is not None
        meant = self.book.plan.loads[pose.load].mass
        told = stand.payload
        if pose.load in self._warned or self._instrument.needs_wrench:  # which is to be found
            return
        if told is not None and abs(told - meant) > HEAVY * max(1.0, meant):
            self._warned.add(pose.load)
            self.talk.warn(
                f"the controller believes that {told:g} kg hang on the flange, the plan {meant:g} "
                "kg: is the right load mounted, and the controller told?"
            )
            self.talk.enter("  Enter when it is put right")
        elif stand.wrench is not None and np.linalg.norm(stand.wrench[:3]) > PULL:
            self._warned.add(pose.load)
            self.talk.warn(
                f"the controller feels {np.linalg.norm(stand.wrench[:3]):.0f} N at the tool: is "
                "the right load mounted, and nothing touching it?"
            )
            self.talk.enter("  Enter when it is put right")
