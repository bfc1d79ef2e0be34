"""One run from its seed: begin, faults, healing, the end; judged all along."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from benchmarks.faults.invariants import Checker
from benchmarks.simulation.can import CanLink
from benchmarks.simulation.canopen import CanopenLink
from benchmarks.simulation.disk import recorded_on
from benchmarks.simulation.faults import ALL, SLOW, Fault, drawn
from benchmarks.simulation.invariants import Judge, Violation
from benchmarks.simulation.links import Setting, SimulatedLink, setting_of
from benchmarks.simulation.modbus import ModbusLink, ModbusTargetLink
from benchmarks.simulation.process_faults import cut_power, fill_disk, kill_recorder
from benchmarks.simulation.processes import Chance, Run, cell_files
from benchmarks.simulation.sensor import SensorLink
from benchmarks.simulation.ur import UrLink, library
from benchmarks.simulation.world import BEGIN, Process, SimulatedClock, World
from gapbridge.bridge.ipc.control_socket import Peer
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.state import Setpoint

LINKS: dict[str, type[SimulatedLink]] = {
    "ur_servoj": UrLink, "ur_offset": UrLink, "modbus": ModbusLink, "can": CanLink,
    "canopen": CanopenLink, "ur_sensor": SensorLink, "odrive": CanLink, "openarm": CanLink,
    "modbus_target": ModbusTargetLink,
}  # fmt: skip
MOST_FAULTS = 4
QUIET, SPAN, REST = 0.3, 0.8, 0.3  # s: until faults begin; over what time they are spread; after
RECOVERY = 25.0  # s until a healed run compensates again
ENDING = 8.0  # s until a stopped run is over
LOOK = 0.02  # s
ASKING = 0.1  # s between two attempts to arm again
Plan = list[tuple[float, Fault]]


@dataclass
class Outcome:
    """What came of a run."""

    seed: int
    link: str
    faults: list[str] = field(default_factory=list)
    violations: list[Violation] = field(default_factory=list)
    writes: int = 0
    oldest: float = 0.0  # s, state behind a write
    hidden: float = 0.0  # s, the same where nothing could show it: no violation
    seconds: float = 0.0  # of simulated time

    def __str__(self) -> str:
        what = "; ".join(self.faults) or "no faults"
        lines = [f"seed {self.seed}, {self.link}: {what}", *(f"  {v}" for v in self.violations)]
        if self.hidden:
            lines.append(
                f"  undetectable: a setpoint of a state sampled {self.hidden:.3f} s before"
            )
        return "\n".join(lines)


def run(
    seed: int,
    say: Any = None,
    plan: Sequence[tuple[float, str]] | None = None,
    later: bool = True,
    on: str | None = None,
) -> Outcome:
    """Run one seed; ``say`` gets every event.

    ``plan``: faults by name, each with its moment (s after the first could be), in place of those
    that the seed draws. ``later`` False: without all that was added to the simulation later, so
    that a seed is the run in which it found something then. ``on``: the link, in place of the
    seed's.
    """
    name = on or list(LINKS)[seed % len(LINKS)]
    world = World(seed)
    clock = SimulatedClock(world)
    setting = setting_of(name)
    chance, faults = _fate(seed, setting, plan, later)
    checker, joint = Checker(setting.bounds), chance.planned_joint
    if joint is not None:  # offsets are what the other joints do
        checker._planned = (joint, setting.wired.start_q[joint])
    judge = Judge(checker, BEGIN, setting.wired.rate)
    link = LINKS[name](world, clock, setting, judge.saw)
    outcome = Outcome(seed, name)
    found = Run(clock, link, chance)
    with library(link), cell_files(found), recorded_on(found.disk):
        _listen(found, judge, say)
        found.start()
        person = Person(found, judge, chance.draw, outcome, faults)
        try:
            world.run(BEGIN + 4 * RECOVERY, lambda: person.done)
            _judge_end(found, judge, person)
        finally:
            world.end()
            for loop in found.loops:
                loop.let_go()
            for recording in found.recordings:
                recording.let_go()
            for daemon in found.daemons:
                daemon._commands.close()
                daemon.memory.close()
    outcome.violations, outcome.writes = judge.violations, judge.writes_noted
    outcome.oldest, outcome.hidden = judge.oldest, judge.hidden
    outcome.seconds = world.now - BEGIN
    return outcome


def plan_of(seed: int) -> Plan:
    """Return which faults a seed has, each with its moment."""
    return _fate(seed, setting_of(list(LINKS)[seed % len(LINKS)]), None, later=True)[1]


def _fate(
    seed: int, setting: Setting, given: Sequence[tuple[float, str]] | None, later: bool
) -> tuple[Chance, Plan]:
    """Return what a seed says of a run, and which faults happen when, s after the first could."""
    draw = random.Random(f"faults {seed}")
    more = random.Random(f"later {seed}") if later else None
    moves_arm = setting.wired.moves_arm
    joint = 0 if moves_arm and draw.random() < 0.4 else None
    if more is not None and moves_arm and more.random() < 0.5:
        joint = 0  # turns about gravity: its own offset is none, and the checker leaves it out
    if given is not None:
        by_name = {fault.name: fault for fault in (*ALL, *SLOW)}
        plan = [(moment, by_name[name]) for moment, name in given]
    else:
        faults = drawn(draw, more, setting.name, draw.randint(0, MOST_FAULTS))
        plan = list(zip(sorted(draw.uniform(0.0, SPAN) for _ in faults), faults, strict=True))
    is_recorded = any(fault.make in (fill_disk, kill_recorder, cut_power) for _, fault in plan)
    return Chance(draw, more, joint, is_recorded), plan


def _listen(run: Run, judge: Judge, say: Any) -> None:
    link = run.link

    def noted(event: dict[str, Any]) -> None:
        whole = {**event, "seen": run.world.now}
        judge.on_event(whole)
        if say is not None and event["kind"] != "status":
            keys = ("kind", "from", "to", "cause", "command", "detail")
            words = " ".join(str(event[k]) for k in keys if k in event)
            say(f"{run.world.now - BEGIN:9.4f} {words}")

    def started() -> None:
        events = run.daemon.event_log
        has_note = bool(run.owner_note)
        judge.begins(run.daemon.configuration.hash, not (has_note or run.is_marked), has_note)
        events._listeners = (*events._listeners, noted)

    def sent(setpoint: Setpoint) -> None:
        state = run.state_behind
        sampled = link.sampled_at(state)
        if isinstance(link, SensorLink) and state.ft_raw_wrench is not None:
            judge.has_wrench(state.received - link.arrived, link.sensor_settings.max_age)
        judge.sent(setpoint, sampled, run.world.now, link.hidden_leap)

    run.on_send, run.on_stop, run.on_start = sent, judge.stops, started


class Person(Process):
    """Arms, has faults happen, heals, arms again, stops."""

    def __init__(
        self, run: Run, judge: Judge, draw: random.Random, outcome: Outcome, plan: Plan
    ) -> None:
        self._plan = plan
        self._of, self._judge, self._draw, self._outcome = run, judge, draw, outcome
        self.done = False
        self.ended_in_time = True
        super().__init__(run.world, "person", self._act)
        run.on_death = self.wake  # who waits for an answer gets none

    def _act(self) -> None:
        run, world, draw = self._of, self.world, self._draw
        self._wait_for(State.OBSERVING, RECOVERY)
        self._ask("arm")
        begin = world.now + draw.uniform(0.0, QUIET)
        for moment, fault in self._plan:
            self._until(begin + moment)
            if self._over or not run.loops:
                break
            words = fault.make(run, draw)
            self._outcome.faults.append(
                f"{fault.name} ({words}) at {world.now - BEGIN:.3f} s" if words
                else f"{fault.name} at {world.now - BEGIN:.3f} s"
            )  # fmt: skip
        self._until(begin + SPAN + draw.expovariate(1.0 / REST))
        if not self._over:
            self._recover()
        asked = world.now
        run.stop()
        run.starts_anew = False
        while not self._over and world.now < asked + ENDING:
            self.sleep(LOOK)
        while run.recordings and not run.recordings[-1].is_closed and world.now < asked + ENDING:
            self.sleep(LOOK)
        self.ended_in_time = self._over
        self.done = True

    @property
    def _over(self) -> bool:
        return self._of.is_over

    def _until(self, time: float) -> None:
        while self.world.now < time and not self._over:
            self.sleep(min(LOOK, time - self.world.now))

    def _wait_for(self, state: State, limit: float) -> bool:
        until = self.world.now + limit
        while self._of.daemon.state != state:
            if self.world.now > until or self._over:
                return False
            self.sleep(LOOK)
        return True

    def _ask(self, command: str) -> dict[str, Any]:
        """Ask as the control socket does, and see whether what is answered is so."""
        process, daemon = self._of.process, self._of.daemon
        answers = list[dict[str, Any]]()

        def ask() -> None:
            try:
                answers.append(daemon.control.answer(command, Peer(1, 1000)))
            finally:
                self.wake()

        if process.dead or process.over:
            return {"ok": False, "error": "found no daemon"}
        request = Process(self.world, "request", ask)
        while not (request.over or process.dead or process.over):  # its threads end with it
            self.sleep(RECOVERY)
        if not answers:
            request.kill()
            return {"ok": False, "error": "the daemon is gone"}
        answer = answers[0]
        observes = answer["ok"] and str(answer["answer"]).endswith("observing")
        if observes and (daemon.state != State.OBSERVING or daemon.latched):
            self._judge.violate("taken", f"{command}: {answer}, in {daemon.state.name}")
        return answer

    def _recover(self) -> None:
        """Heal everything, acknowledge, and arm until it compensates."""
        run, until = self._of, self.world.now + RECOVERY
        run.link.heal()
        run.link.down._ordered = True
        if run.planner is not None:
            run.planner.silent_until, run.planner.nonsense = 0.0, None
        answer: dict[str, Any] = {}
        if run.daemon._stopping.is_set() and not run.starts_anew:
            return
        if run.disk is not None:
            run.disk.is_full = False
        run.cell_file = "same"
        compensators = [p.loop._stream._compensator for p in run.loops if p.loop is not None]
        for compensator in compensators:
            compensator.__dict__.pop("correct", None)
        while self.world.now < until and not self._over:
            self.sleep(ASKING)
            if run.compensates:
                return
            run.link.heal()
            self._ask("disarm")
            answer = self._ask("arm")
            if run.compensates:
                return
        words = f"{run.daemon.state.name} in the end; {answer.get('error') or answer}"
        if self._over:
            words = f"the daemon ended: {run.process.error or run.process.result}"
        self._judge.violate("recovers", words)


def _judge_end(run: Run, judge: Judge, person: Person) -> None:
    """Judge what can be judged only when all is over."""
    judge._now = run.world.now
    for process in run.world.processes:
        if process.error and process not in run.not_started:
            last = process.error.strip().splitlines()
            judge.violate("crash", f"{process.name}: {last[-1]} ({' '.join(last[-3:-1])})")
    if not person.done:
        judge.violate("ends", "the run did not come to its end")
    elif not person.ended_in_time:
        judge.violate("ends", f"not over {ENDING:g} s after the stop")
    elif not run.process.error and not run.process.dead and run.process.result is None:
        judge.violate("ends", "there is no summary")
    taken, last = run.daemon.last_taken, run.daemon._commands.last
    if person.done and taken > last:
        judge.violate("taken", f"{taken} taken of {last}")
    left = 0
    for daemon in run.daemons:
        memory = daemon.memory
        rows, _ = memory.rows(0, memory.written)
        judge.judge_limited(rows, memory.slices)
        left += int((rows[:, memory.slices["written"]] == 1.0).sum())
    for recording in run.recordings:
        if person.ended_in_time and (missing := recording.missing()):
            judge.violate(
                "files", f"{missing} cycles are in no file, and none was reported as lost"
            )
    deaths = sum(loop.process.dead for loop in run.loops)
    if not left <= run.left <= left + deaths:
        judge.violate("recorded", f"{run.left} setpoints were sent, {left} are recorded")
