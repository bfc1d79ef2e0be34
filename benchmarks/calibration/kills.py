"""Kill -9 at random moments of a session: no reading may be lost, and it must always go on.

A session whose instrument is a file and whose joints are as planned, so that nothing waits for
people. The command is killed at random moments after it has begun to measure; every reading that it
had reported before ("kept") must stand in the journal, unchanged, and the same command must go on.

    python -m benchmarks.calibration.kills --kills 100

The first ``--whole`` kills start the command anew, as a terminal does; the others fork it from this
process, which has its libraries loaded already: the same code from its first line on, without the
seconds that Python takes to begin.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.calibration.children import PYTHON, Child, Start, environment, forked, started
from gapbridge.bridge.calibration.session.journal import FILE, read_entries
from gapbridge.bridge.calibration.session.session import plan_of
from gapbridge.core.arm import builtin_arm
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model

CELL = """\
robot: {model: ur10e}
metrology: {registered: true, sigma: 2.0e-5}
calibration:
  instrument: {kind: file, unit: mm, file: readings.csv}
  joints: planned
  loads: [{name: light, mass: 1.0}, {name: heavy, mass: 9.0, cog: [0.0, 0.0, 0.1]}]
  effects: [axial_compliance]
  poses: 24
  held_out: 8
  repeats: 2
  folder: sessions
"""
MOST_KEPT = 4  # readings before a kill
LONGEST_WAIT = 0.3  # s
AXIAL = (3e-6, 8e-6, 7e-6, 1e-5, 1.2e-5, 2e-5)  # rad/Nm


@dataclass
class Tally:
    """What the kills have shown."""

    kills: int = 0
    sessions: int = 1
    acknowledged: int = 0  # readings reported before a kill
    lost: int = 0  # of these, not in the journal
    torn: int = 0  # kills that tore the last line
    refused: int = 0  # starts that did not go on


def run(kills: int, seed: int, say: bool = True, whole: int | None = None) -> Tally:
    """Kill sessions ``kills`` times, after ``whole`` (None: all) real starts forked ones.

    Returns what was lost.
    """
    rng, tally = np.random.default_rng(seed), Tally()
    start: Start = started
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        template = _planned(folder)
        session = _fresh(folder, template, tally.sessions)
        while tally.kills < kills:
            when = int(rng.integers(0, MOST_KEPT)), float(rng.uniform(0.0, LONGEST_WAIT))
            if whole is not None and tally.kills >= whole and start is started:
                importlib.import_module("gapbridge.bridge.calibration.jobs.calibrate")
                start = forked
            ended = _killed_once(start(_command(folder, session)), session, when, tally)
            if say:
                print(f"\r{tally}", end="", flush=True)
            if ended:
                tally.sessions += 1
                session = _fresh(folder, template, tally.sessions)
    return tally


def _planned(folder: Path) -> Path:
    """Write cell and readings, and plan; returns the folder of the planned session."""
    (folder / "cell.yaml").write_text(CELL, encoding="utf-8")
    session = folder / "template"
    subprocess.run(
        [*PYTHON, *_command(folder, session, "--plan-only")], check=True,
        stdout=subprocess.DEVNULL, env=environment(),
    )  # fmt: skip
    entries = read_entries(session / FILE)
    plan = plan_of(next(e["plan"] for e in entries if e["kind"] == "plan"))
    q = np.array([p.q for p in plan.poses])
    loads = Loads(
        payload_mass=np.array([plan.loads[p.load].mass for p in plan.poses]),
        payload_cog=np.array([plan.loads[p.load].cog for p in plan.poses]),
    )
    model = Model(builtin_arm("ur10e")).with_compliance(AXIAL, (0.0,) * 6)
    position = model.predict(q, loads).position
    position = position + np.random.default_rng(0).normal(0, 2e-5, position.shape)
    rows = [f"{i + 1},{','.join(f'{v * 1e3:.4f}' for v in p)}" for i, p in enumerate(position)]
    (folder / "readings.csv").write_text("\n".join(["stop,x,y,z", *rows, ""]), encoding="utf-8")
    return session


def _fresh(folder: Path, template: Path, number: int) -> Path:
    session = folder / f"session{number}"
    shutil.copytree(template, session)
    return session


def _command(folder: Path, session: Path, *more: str) -> list[str]:
    return ["calibrate", str(folder / "cell.yaml"), "--session", str(session), *more]


def _killed_once(child: Child, session: Path, when: tuple[int, float], tally: Tally) -> bool:
    """Kill a session that goes on; returns whether all stops were measured by then.

    ``when``: after how many readings, and how long after the last of them, s.
    """
    before = [e for e in read_entries(session / FILE) if e["kind"] == "reading"]
    reported, kept, begun = b"", 0, False
    count = min(when[0], _stops(session) - len(before))
    for line in child.shown:
        reported += line
        begun |= line.startswith(b"instrument:")
        kept += line.startswith(b"  kept")
        if begun and kept >= count:
            break
    if not begun:
        tally.refused += 1
        raise RuntimeError(f"the session did not go on: {reported.decode()[-600:]}")
    time.sleep(when[1])
    os.killpg(child.pid, signal.SIGKILL)
    reported += child.shown.read()
    child.close()
    _count(session, before, reported, tally)
    done = sum(e["kind"] == "reading" for e in read_entries(session / FILE))
    return done >= _stops(session)


def _stops(session: Path) -> int:
    """Return how many stops a session's plan has."""
    entry = next(e for e in read_entries(session / FILE) if e["kind"] == "plan")
    return len(entry["plan"]["poses"])


def _count(session: Path, before: list[dict[str, object]], reported: bytes, tally: Tally) -> None:
    raw = (session / FILE).read_bytes()
    tally.kills += 1
    tally.torn += not raw.endswith(b"\n")
    whole = [json.loads(line) for line in raw.split(b"\n")[:-1]]
    after = [e for e in whole if e["kind"] == "reading"]
    acknowledged = reported.count(b"  kept  ")
    tally.acknowledged += acknowledged
    tally.lost += max(len(before) + acknowledged - len(after), 0)
    if after[: len(before)] != before:
        tally.lost += 1
    stops = [e["stop"] for e in after]
    if len(set(stops)) != len(stops):
        raise RuntimeError(f"stops measured twice: {stops}")


def main() -> None:
    """Run it and print the tally."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--whole", type=int, default=10, help="kills of commands begun anew")
    given = parser.parse_args()
    begun = time.monotonic()
    tally = run(given.kills, given.seed, whole=given.whole)
    print(f"\r{tally.kills} kills in {tally.sessions} sessions, {time.monotonic() - begun:.0f} s: "
          f"{tally.acknowledged} readings reported, {tally.lost} lost, {tally.torn} torn lines, "
          f"{tally.refused} starts refused")  # fmt: skip


if __name__ == "__main__":
    main()
