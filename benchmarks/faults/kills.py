"""kill -9 of any process of a run at random moments: ``python -m benchmarks.faults.kills``.

Whatever is killed, the recording must be readable to within a second of it, the run must go on or
start anew with the same command, and nothing is cleaned by hand in between.
"""

from __future__ import annotations

import json
import random
import signal
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import click
import psutil

from benchmarks.faults.controller_process import ControllerProcess
from benchmarks.faults.links import LIMITS, LINKS
from benchmarks.faults.process_run import END_LIMIT, ProcessRun
from benchmarks.faults.report import PAGE, fill
from benchmarks.ports import free_port, own_host
from gapbridge.bridge.ipc.control_client import ask
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.log.mcap_reading import last_batch

LOST = 1.0  # s before a kill that a recording may lack
CAUGHT_UP = 5.0  # s that a new recorder has for what the killed one had not written
LIMIT = 120.0  # s to start, or to go on
VICTIMS = ("daemon", "loop_main", "recording", "web", "metrics")


@dataclass
class Deaths:
    """What came of killing."""

    kills: dict[str, int] = field(default_factory=lambda: dict.fromkeys(VICTIMS, 0))
    longest_gone: dict[str, float] = field(default_factory=dict)  # s until it was there again
    most_lost: float = 0.0  # s of recording before a kill
    wrong: list[str] = field(default_factory=list)

    def table(self) -> str:
        """Return it as a table."""
        lines = ["| killed | times | there again after, s, at most |", "| --- | --- | --- |"]
        lines += [
            f"| {name} | {self.kills[name]} | {self.longest_gone.get(name, 0.0):.1f} |"
            for name in VICTIMS
        ]
        lost = f"Recordings lacked at most {self.most_lost:.2f} s before a kill"
        return "\n".join([*lines, "", f"{lost}; not as expected: {len(self.wrong) or 'none'}."])


class Scene:
    """A controller, a cell, and the run that is killed."""

    def __init__(self, folder: Path, link: str) -> None:
        self.link = LINKS[link]()
        self.host = own_host()
        more = LIMITS.replace("folder: null", "folder: recordings")
        more += f"web: {{port: {free_port()}}}\nmetrics: {{port: {free_port()}}}\n"
        self.cell, controller_cell = self.link.write_cells(folder, self.host, self.host, more)
        self.controller = ControllerProcess(
            controller_cell, self.host, 30100, folder / "controller.log"
        )
        self.controller.start()
        self.folder = folder / "recordings"
        self.begin()

    def begin(self) -> float:
        """Start a run, armed; returns how long that took, s."""
        begun = time.monotonic()
        self.link.prepare(self.controller, self.host)
        self.run = ProcessRun(self.cell)
        self.run.start()
        self.reach(State.COMPENSATING)
        return time.monotonic() - begun

    def reach(self, state: State) -> None:
        """Wait for a state, arming where it takes a person. Raises TimeoutError."""
        until = time.monotonic() + LIMIT
        while self.run.state != state:
            if time.monotonic() > until or not self.run.alive:
                raise TimeoutError(f"{self.run.last_words()}; {self.run.output[-300:]}")
            if self.run.state == State.FAULT:
                ask(self.cell, "disarm")
            elif self.run.state == State.OBSERVING:
                try:
                    ask(self.cell, "arm")
                except GapbridgeError:
                    time.sleep(0.1)
            time.sleep(0.02)

    def last_cycle(self) -> float:
        """Return the controller's time of the newest cycle that the loop has handed over, s."""
        memory = self.run.memory
        rows, _ = memory.rows(max(memory.written - 20, 0), memory.written)
        return float(rows[-1, memory.slices["timestamp"].start]) if len(rows) else 0.0

    def recorded(self) -> float:
        """Return the controller's time of the newest cycle that can be read of the recording, s."""
        newest = sorted(self.folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime)
        for path in reversed(newest):
            batch = last_batch(path)
            if batch is not None:
                return float(batch.columns["timestamp"][-1])
        return 0.0


def kill(scene: Scene, name: str, found: Deaths) -> None:
    """Kill a process, and see that all goes on."""
    run, before = scene.run, scene.run.processes()
    process = before[name]
    process.send_signal(signal.SIGKILL)
    last, begun = scene.last_cycle(), time.monotonic()
    found.kills[name] += 1
    if name == "daemon":
        _, left = psutil.wait_procs(before.values(), END_LIMIT + 10.0)
        if left:
            found.wrong.append(f"the daemon was killed, and {left} lived on")
    if name == "daemon":
        _lost(found, name, last - scene.recorded())
        gone = scene.begin()
    else:
        until = begun + LIMIT
        while (again := run.processes().get(name)) is None or again.pid == process.pid:
            if time.monotonic() > until or not run.alive:
                raise TimeoutError(f"{name} did not come back: {run.last_words()}")
            time.sleep(0.02)
        gone = time.monotonic() - begun
        scene.reach(State.COMPENSATING)
        if name == "recording":  # the next one takes what it has not written out of the ring
            until = time.monotonic() + CAUGHT_UP
            while (lost := last - scene.recorded()) > 0.0 and time.monotonic() < until:
                time.sleep(0.05)
            _lost(found, name, lost)
    found.longest_gone[name] = max(found.longest_gone.get(name, 0.0), gone)


def _lost(found: Deaths, name: str, seconds: float) -> None:
    """Note how much of a recording cannot be read, s."""
    found.most_lost = max(found.most_lost, seconds)
    if seconds > LOST:
        found.wrong.append(f"{name}: the recording lacks {seconds:.2f} s")


def run_kills(count: int, seed: int, folder: Path, link: str, limit: float) -> Deaths:
    """Kill ``count`` times, for ``limit`` s at most; returns what came of it."""
    found, draw, until = Deaths(), random.Random(seed), time.monotonic() + limit
    scene = Scene(folder, link)
    try:
        while sum(found.kills.values()) < count and time.monotonic() < until:
            time.sleep(draw.uniform(0.0, 1.5))
            name = draw.choice(VICTIMS)
            if name not in scene.run.processes():
                continue  # it was killed just now, and is not there yet
            try:
                kill(scene, name, found)
            except (TimeoutError, GapbridgeError) as error:
                found.wrong.append(f"{name}: {type(error).__name__}: {error}")
                click.echo(found.wrong[-1])
                scene.run.stop()
                scene.begin()
            if sum(found.kills.values()) % 20 == 0:
                click.echo(f"{found.kills}: {len(found.wrong)} wrong")
            (folder / "kills.json").write_text(json.dumps(asdict(found)), encoding="utf-8")
    finally:
        scene.run.stop()
        scene.controller.stop()
    return found


@click.command()
@click.option("--count", default=200, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--link", type=click.Choice(list(LINKS)), default="can", show_default=True)
@click.option("--minutes", default=60.0, show_default=True, help="No kill is begun after them.")
@click.option("--page", is_flag=True, help="Fill docs/reliability.md.")
def main(count: int, seed: int, link: str, minutes: float, page: bool) -> None:
    """Kill any process of a run at random moments."""
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    found = run_kills(count, seed, folder, link, 60.0 * minutes)
    click.echo(found.table())
    for message in found.wrong:
        click.echo(f"NOT AS EXPECTED: {message}")
    if page:
        fill(PAGE, "kills", found.table())
    sys.exit(1 if found.wrong else 0)


if __name__ == "__main__":
    main()
