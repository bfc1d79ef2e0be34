"""A whole daemon and its loop in simulated time."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from benchmarks.simulation.links import setting_of
from benchmarks.simulation.processes import Chance, cell_files
from benchmarks.simulation.processes import Run as SimulatedRun
from benchmarks.simulation.sequence import LINKS
from benchmarks.simulation.ur import library
from benchmarks.simulation.world import Process, SimulatedClock, World
from gapbridge.bridge.ipc.control_socket import Peer
from gapbridge.bridge.ipc.loop_state import State


@contextmanager
def rides_on_a_program(seed: int = 3, arm: bool = True) -> Iterator[tuple[SimulatedRun, World]]:
    """A whole daemon and its loop on a UR's own program, in simulated time; armed or not."""
    world = World(seed)
    link = LINKS["ur_offset"](world, SimulatedClock(world), setting_of("ur_offset"), lambda _: None)
    run = SimulatedRun(link.clock, link, Chance(random.Random(seed), None, None))
    with library(link), cell_files(run):
        run.start()
        try:
            until(world, lambda: run.daemon.state == State.OBSERVING)
            if arm:
                ask(run, "arm")
                assert run.daemon.state == State.COMPENSATING
            yield run, world
        finally:
            world.end()
            run.daemon._commands.close()
            run.daemon.memory.close()


def until(world: World, over: Callable[[], bool], limit: float = 30.0) -> None:
    world.run(world.now + limit, over)
    assert over()


def ask(run: SimulatedRun, command: str) -> dict[str, Any]:
    """Return what the control socket answers."""
    world, before = run.world, run.world.now
    person = Process(world, "person", lambda: run.daemon.control.answer(command, Peer(1, 1000)))
    until(world, lambda: person.over, 60.0)
    assert person.error == "", (before, person.error)
    return dict(person.result)


def causes(run: SimulatedRun) -> list[str]:
    return [e["cause"] for e in run.daemon.event_log.recent if e["kind"] == "transition"]
