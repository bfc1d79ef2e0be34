"""Brings the arm, its load and the instrument to where the next reading is taken."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from gapbridge.bridge.calibration.format import joints_text, load_text
from gapbridge.bridge.calibration.instruments.instrument import AnyInstrument, ReadingError
from gapbridge.bridge.calibration.joints.joint_source import JointSample, JointSource, PlannedJoints
from gapbridge.bridge.calibration.session.prompt import Prompt
from gapbridge.bridge.calibration.session.session import Session
from gapbridge.bridge.cell.settings.calibration import CalibrationSettings
from gapbridge.core.arrays import Array, Mask
from gapbridge.core.calibration.plan import PlannedPose
from gapbridge.core.errors import LinkError, RunError

CONFIRM_DISTANCE = np.radians(3.0)  # rad: farther from the pose than this, it asks for confirmation
AT_POSE = 2e-3  # rad: an arm this near to the pose is not moved
LOAD_TOLERANCE = 0.05  # kg, and share: of the controller's payload from the plan's
MAX_FREE_FORCE = 12.0  # N, of the TCP force without contact
CollisionCheck = Callable[[Array], Array]  # joint angles (N, n) rad -> which are free (N,)
PATH_SAMPLES = 60  # points checked on a straight path
BATCH_SIZE = 40  # paths checked at once


def route(
    is_free: CollisionCheck, begin: Array, end: Array, known: Sequence[Array]
) -> list[Array] | None:
    """Return via poses of a free path from ``begin`` to ``end``, (n,) rad; None: none was found.

    A straight path in joint space has none; otherwise the shortest through one or two of ``known``.
    """
    if all_free(is_free, begin[None], end[None])[0]:
        return []
    nodes = np.array(known, dtype=float).reshape(-1, len(begin))
    out = np.flatnonzero(all_free(is_free, np.broadcast_to(begin, nodes.shape), nodes))
    back = np.flatnonzero(all_free(is_free, nodes, np.broadcast_to(end, nodes.shape)))
    for paths in ([(i,) for i in np.intersect1d(out, back)], [(i, j) for i in out for j in back]):
        free = _shortest_free(is_free, [[begin, *nodes[list(p)], end] for p in paths])
        if free is not None:
            return free[1:-1]
    return None


def _shortest_free(is_free: CollisionCheck, paths: list[list[Array]]) -> list[Array] | None:
    """Return the shortest path all of whose segments are free."""

    def length(path: list[Array]) -> float:
        return float(np.abs(np.diff(path, axis=0)).max(axis=1).sum())

    paths = sorted(paths, key=length)
    for first in range(0, len(paths), BATCH_SIZE):
        some = np.array(paths[first : first + BATCH_SIZE])
        legs = [all_free(is_free, some[:, k], some[:, k + 1]) for k in range(1, some.shape[1] - 2)]
        free = np.flatnonzero(np.all(legs, axis=0)) if legs else np.arange(len(some))
        if len(free):
            return list(some[free[0]])
    return None


def all_free(is_free: CollisionCheck, begin: Array, end: Array) -> Mask:
    """Return which straight paths (N,) from ``begin`` to ``end``, both (N, n) rad, are free."""
    if not len(begin):
        return np.zeros(0, dtype=bool)
    share = np.linspace(0, 1, PATH_SAMPLES)[:, None]
    between = begin[:, None] + share * (end - begin)[:, None]
    free = np.asarray(is_free(between.reshape(-1, begin.shape[1])), dtype=bool)
    return np.asarray(free.reshape(len(begin), PATH_SAMPLES).all(axis=1))


class Positioning:
    """Asks the operator to mount loads and to jog the arm, or moves it after confirmation."""

    def __init__(
        self, prompt: Prompt, session: Session, joints: JointSource, instrument: AnyInstrument,
        is_free: CollisionCheck, settings: CalibrationSettings,
    ) -> None:  # fmt: skip
        self.prompt, self.session, self.joints = prompt, session, joints
        self.minutes_per_load = settings.minutes_per_load
        self._instrument, self._is_free = instrument, is_free
        self._speed = settings.speed
        self._places = [settings.instrument_at or [], *settings.further_places]
        self._confirmed_load: int | None = None  # load for which moving was asked about
        self._may_move = False
        self._warned: set[int] = set()

    def place_instrument(self, number: int) -> None:
        """Ask for the instrument to be moved to a planned position (index from 0)."""
        place = self._places[number] if self._places[number:] else []
        position = ", ".join(f"{v:g}" for v in place) or "?"
        self.prompt.say()
        self.prompt.say(
            f"place {number + 1} · {self._instrument.placed_part} at about ({position}) m in base",
            "bold cyan",
        )
        self.prompt.enter("  Enter when it is there")

    def mount_load(self, load: int) -> None:
        """Ask for a load (index) to be mounted, and whether the arm may be moved with it."""
        if load != self.session.mounted:
            self._ask_to_mount(load)
        if self.joints.can_move and self._confirmed_load != load:
            count = sum(p.load == load for p in self.session.stops)
            self.prompt.say()
            self._may_move = False  # a command typed as the answer leaves here
            self._may_move = self.prompt.confirm(
                f"The arm will be moved to {count} poses with load {load + 1}, at most "
                f"{self._speed:g} rad/s. Keep clear, a hand at the stop button. Move it?"
            )
            if not self._may_move:
                self.prompt.say("  not moved: jog it to each stop as shown")
            self._confirmed_load = load

    def _ask_to_mount(self, load: int) -> None:
        assert self.session.plan is not None
        payload = self.session.plan.loads[load]
        self.prompt.say()
        self.prompt.say(f"load {load + 1} · {load_text(payload)}", "bold cyan")
        if self._instrument.needs_wrench:
            self.prompt.say("  is it on the flange, with nothing touching it?")
        else:
            self.prompt.say("  mount it on the flange, and enter its mass and centre")
        self.prompt.enter("  Enter when it is mounted")
        self._instrument.set_load(payload)
        self.session.add("mounted", load=load)

    def reach(self, pose: PlannedPose) -> JointSample | None:
        """Return a sample once the arm is at rest at the pose.

        None if the tool is brought into contact by hand: joints are sampled after the reading.
        """
        if self._may_move and not self._at_pose(pose):
            self._move(pose)
        if not self._may_move:
            self.prompt.say(f"  {joints_text(pose.q)}")
        if self._instrument.contact:
            return None
        sample = self._wait_for_rest(pose)
        self._check_load(pose, sample)
        return sample

    def _move(self, pose: PlannedPose) -> None:
        """Move the arm to the pose; after a failed move only a 'yes' lets it move again."""
        via = self._find_path(pose)
        while via is not None:
            try:
                with self.prompt.waiting("driving"):
                    self.joints.move_to(pose, via)
            except LinkError:  # nothing observes the arm: the session is to be resumed
                raise
            except RunError as error:
                self.prompt.warn(str(error))
                # withdrawn before asking: a command typed as the answer leaves here
                load, self._confirmed_load, self._may_move = self._confirmed_load, None, False
                if self.prompt.confirm("  Continue from here?"):
                    self._confirmed_load, self._may_move = load, True
                    via = self._find_path(pose)
                    continue
                self.prompt.say("  jog it to this pose, or `quit` and look at the arm")
            return

    def _at_pose(self, pose: PlannedPose) -> bool:
        now = self.joints.current_q()
        return now is not None and bool(np.abs(now - pose.q).max() < AT_POSE)

    def _find_path(self, pose: PlannedPose) -> list[Array] | None:
        """Return via poses of a collision-free path; None: no path is known."""
        begin = self.joints.current_q()
        if begin is None:
            return None
        known = [r.q for r in self.session.accepted] + [p.q for p in self.session.stops]
        via = route(self._is_free, begin, pose.q, known)
        if via is None:
            self.prompt.warn(
                "no collision-free path to this pose was found: jog the arm there, or `skip`"
            )
            self.prompt.say(f"  {joints_text(pose.q)}")
        elif via:
            self.prompt.say(
                f"  moving through {len(via)} other pose{'s'[: len(via) > 1]} of the plan"
            )
        return via

    def _wait_for_rest(self, pose: PlannedPose) -> JointSample:
        while True:
            try:
                if not self.joints.detects_rest:
                    planned = isinstance(self.joints, PlannedJoints)
                    if planned and not self._instrument.self_triggered:
                        self.prompt.enter("  Enter when it is there")
                    return self.joints.sample_at_rest(pose)
                sample = self.joints.arrived(pose)
                if sample is None:
                    sample = self._wait_for_jogging(pose)
                if sample is not None:
                    return sample
            except ReadingError as error:
                self.prompt.warn(str(error))

    def _wait_for_jogging(self, pose: PlannedPose) -> JointSample | None:
        """Wait until the arm is at rest at the pose, or the operator accepts its position.

        Raises ReadingError if the arm does not come to rest, or nothing is known of it.
        """
        question = "  measured as soon as it rests there (Enter: where it is now)"
        typed = self.prompt.ask_unless(question, lambda: self.joints.arrived(pose))
        if isinstance(typed, JointSample):
            return typed
        if typed:
            self.prompt.say(f"  found {typed!r}, expected Enter, or a command of the session (`?`)")
            return None
        now = self.joints.current_q()
        if now is None:
            raise ReadingError("the controller reports no joints now: is the link to the arm up?")
        apart = np.abs(now - pose.q)
        if apart.max() > CONFIRM_DISTANCE:
            joint = int(apart.argmax())
            distance = f"  J{joint + 1} is {np.degrees(apart[joint]):.1f}° away."
            if not self.prompt.confirm(f"{distance} Measure here anyway?"):
                return None
        return self.joints.sample_at_rest(pose)

    def _check_load(self, pose: PlannedPose, sample: JointSample) -> None:
        """Warn if the controller has another payload than the plan, or reports a contact force."""
        assert self.session.plan is not None
        planned, declared = self.session.plan.loads[pose.load].mass, sample.payload
        force = 0.0 if sample.wrench is None else float(np.linalg.norm(sample.wrench[:3]))
        if pose.load in self._warned or self._instrument.needs_wrench:  # it is identified
            return
        if declared is not None and abs(declared - planned) > LOAD_TOLERANCE * max(1.0, planned):
            self._warned.add(pose.load)
            self.prompt.warn(
                f"the controller's payload is {declared:g} kg, the plan's "
                f"{planned:g} kg: is the right load mounted, and set in the controller?"
            )
            self.prompt.enter("  Enter when it is corrected")
        elif force > MAX_FREE_FORCE:
            self._warned.add(pose.load)
            self.prompt.warn(
                f"the controller measures {force:.0f} N at the tool: is the right load mounted, "
                "and nothing touching it?"
            )
            self.prompt.enter("  Enter when it is corrected")
