"""The arm and its load, brought to where the next reading is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.calibration.format import degrees, load_text
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource, PlannedJoints
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import RunError

FAR = np.radians(3.0)  # an arm farther from the pose than this is asked about
THERE = 2e-3  # rad: an arm this near need not be driven
HEAVY = 0.05  # kg, and share: the controller's payload may differ from the plan's by as much
PULL = 12.0  # N at a tool that nothing touches
Clear = Callable[[Array], Array]
CHECKED = 60  # points of a straight way that are looked at
AT_ONCE = 40  # ways


def route(clear: Clear, begin: Array, end: Array, known: Sequence[Array]) -> list[Array] | None:
    """Return the joints (n,) to go by between ``begin`` and ``end``; None: no way is found.

    Straight where that is free, else by one or two of the ``known`` poses, the shortest such way.
    ``clear`` says for joints (N, n) whether they are free.
    """
    if all_free(clear, begin[None], end[None])[0]:
        return []
    nodes = np.array(known, dtype=float).reshape(-1, len(begin))
    out = np.flatnonzero(all_free(clear, np.broadcast_to(begin, nodes.shape), nodes))
    back = np.flatnonzero(all_free(clear, nodes, np.broadcast_to(end, nodes.shape)))
    for ways in ([(i,) for i in np.intersect1d(out, back)], [(i, j) for i in out for j in back]):
        found = _first_free(clear, [[begin, *nodes[list(way)], end] for way in ways])
        if found is not None:
            return found[1:-1]
    return None


def _first_free(clear: Clear, ways: list[list[Array]]) -> list[Array] | None:
    """Return the shortest way whose every leg is free."""

    def length(way: list[Array]) -> float:
        return float(np.abs(np.diff(way, axis=0)).max(axis=1).sum())

    ways = sorted(ways, key=length)
    for at in range(0, len(ways), AT_ONCE):
        some = np.array(ways[at : at + AT_ONCE])
        legs = [all_free(clear, some[:, k], some[:, k + 1]) for k in range(1, some.shape[1] - 2)]
        free = np.flatnonzero(np.all(legs, axis=0)) if legs else np.arange(len(some))
        if len(free):
            return list(some[free[0]])
    return None


def all_free(clear: Clear, begin: Array, end: Array) -> Mask:
    """Return which straight ways (N,) from ``begin`` to ``end``, both (N, n), are free."""
    if not len(begin):
        return np.zeros(0, dtype=bool)
    share = np.linspace(0, 1, CHECKED)[:, None]
    between = begin[:, None] + share * (end - begin)[:, None]
    free = np.asarray(clear(between.reshape(-1, begin.shape[1])), dtype=bool)
    return np.asarray(free.reshape(len(begin), CHECKED).all(axis=1))


class Positioning:
    """Loads mounted by people; the arm jogged by them, or driven after their yes.

    ``clear`` says for joints (N, n) whether they are free of what the cell names.
    """

    def __init__(
        self, prompt: Prompt, session: Session, joints: JointSource, instrument: AnyInstrument,
        clear: Callable[[Array], Array], settings: CalibrationSettings,
    ) -> None:  # fmt: skip
        self.prompt, self.session, self.joints = prompt, session, joints
        self.minutes_per_load = settings.minutes_per_load
        self._instrument, self._clear, self._speed = instrument, clear, settings.speed
        self._places = [settings.instrument_at or [], *settings.further_places]
        self._asked: int | None = None  # load for which driving was asked about
        self._driven = False
        self._warned: set[int] = set()

    def place(self, number: int) -> None:
        """Have the instrument carried to one of its planned places."""
        at = ", ".join(f"{v:g}" for v in self._places[number]) if self._places[number:] else "?"
        self.prompt.say()
        self.prompt.say(
            f"place {number + 1} · {self._instrument.stands} at about ({at}) m in base",
            "bold cyan",
        )
        self.prompt.enter("  Enter when it is there")

    def mount(self, load: int) -> None:
        """Have a load mounted, and ask whether the arm may be driven with it."""
        if load != self.session.mounted:
            self._hang(load)
        if self.joints.drives and self._asked != load:
            left = sum(p.load == load for p in self.session.stops)
            self.prompt.say()
            self._driven = self.prompt.confirm(
                f"The arm will be moved to {left} poses with load {load + 1}, at most "
                f"{self._speed:g} rad/s. Keep clear, a hand at the stop button. Move it?"
            )
            if not self._driven:
                self.prompt.say("  not moved: jog it to each stop as shown")
            self._asked = load

    def _hang(self, load: int) -> None:
        assert self.session.plan is not None
        what = self.session.plan.loads[load]
        self.prompt.say()
        self.prompt.say(f"load {load + 1} · {load_text(what)}", "bold cyan")
        if self._instrument.needs_wrench:
            self.prompt.say("  is it on the flange, with nothing touching it?")
        else:
            self.prompt.say("  mount it on the flange, and enter its mass and centre")
        self.prompt.enter("  Enter when it is mounted")
        self._instrument.hung(what)
        self.session.add("mounted", load=load)

    def bring(self, pose: PlannedPose) -> JointSample | None:
        """Return where the arm rests, once it does so at the pose.

        None where the instrument has it seated by hand afterwards.
        """
        if self._driven and not self._there(pose):
            self._drive(pose)
        if not self._driven:
            self.prompt.say(f"  {degrees(pose.q)}")
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
                with self.prompt.waiting("driving"):
                    self.joints.drive(pose, via)
            except RunError as error:
                self.prompt.warn(str(error))
                if self.prompt.confirm("  Continue from here?"):
                    via = self._way(pose)
                    continue
                self.prompt.say("  jog it to this pose, or `quit` and look at the arm")
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
        known = [t.q for t in self.session.taken] + [p.q for p in self.session.stops]
        via = route(self._clear, begin, pose.q, known)
        if via is None:
            self.prompt.warn(
                "no collision-free path to this pose was found: jog the arm there, or `skip`"
            )
            self.prompt.say(f"  {degrees(pose.q)}")
        elif via:
            self.prompt.say(
                f"  moving through {len(via)} other pose{'s'[: len(via) > 1]} of the plan"
            )
        return via

    def _rested(self, pose: PlannedPose) -> JointSample:
        while True:
            try:
                if not self.joints.watches:
                    if isinstance(self.joints, PlannedJoints) and not self._instrument.waits:
                        self.prompt.enter("  Enter when it is there")
                    return self.joints.stand(pose)
                found = self.joints.arrived(pose)
                if found is None:
                    found = self._jogged(pose)
                if found is not None:
                    return found
            except ReadingError as error:
                self.prompt.warn(str(error))

    def _jogged(self, pose: PlannedPose) -> JointSample | None:
        """Wait until the arm rests at the pose, or a person says that it stands well."""
        question = "  measured as soon as it rests there (Enter: where it is now)"
        typed = self.prompt.ask_unless(question, lambda: self.joints.arrived(pose))
        if isinstance(typed, JointSample):
            return typed
        if typed:
            self.prompt.say(f"  found {typed!r}, expected Enter, or a command of the session (`?`)")
            return None
        now = self.joints.now()
        if now is None:
            return None
        apart = np.abs(now - pose.q)
        if apart.max() > FAR:
            joint = int(apart.argmax())
            far = f"  J{joint + 1} is {np.degrees(apart[joint]):.1f}° away."
            if not self.prompt.confirm(f"{far} Measure here anyway?"):
                return None
        return self.joints.stand(pose)

    def _look_at_load(self, pose: PlannedPose, stand: JointSample) -> None:
        """Report where the controller believes in another load, or reports a force."""
        assert self.session.plan is not None
        meant = self.session.plan.loads[pose.load].mass
        believed = stand.payload
        if pose.load in self._warned or self._instrument.needs_wrench:  # which is to be found
            return
        if believed is not None and abs(believed - meant) > HEAVY * max(1.0, meant):
            self._warned.add(pose.load)
            self.prompt.warn(
                f"the controller's payload is {believed:g} kg, the plan's "
                f"{meant:g} kg: is the right load mounted, and set in the controller?"
            )
            self.prompt.enter("  Enter when it is corrected")
        elif stand.wrench is not None and np.linalg.norm(stand.wrench[:3]) > PULL:
            self._warned.add(pose.load)
            self.prompt.warn(
                f"the controller measures {np.linalg.norm(stand.wrench[:3]):.0f} N at the tool: is "
                "the right load mounted, and nothing touching it?"
            )
            self.prompt.enter("  Enter when it is corrected")
