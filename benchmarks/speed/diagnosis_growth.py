"""How a diagnosis grows: with the effects it looks at, with the poses of the log."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from benchmarks.fleet.simulating import write_fleet
from gapbridge.bridge.cell import load_cell
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.effects import CATALOGUE
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.metrology import Metrology
from gapbridge.core.model import Model

THERE = ("axial_compliance", "radial_compliance")  # what the simulated arms of a fleet have
POSES = (20, 40, 70, 140, 280, 560, 1120)
TURNS = 3
LARGE = 280  # poses from which once is enough: other work is a smaller share of it


def by_effects(poses: int = 70, seed: int = 3) -> list[dict[str, float]]:
    """Return the CPU time of a diagnosis by the number of effects of the position channel.

    Those that the log holds are looked at always; the others come in the catalogue's order.
    """
    model, log, metrology = _case(poses, seed)
    others = [name for name, effect in CATALOGUE.items()
              if "position" in effect.channels and name not in THERE]  # fmt: skip
    _cpu(model, log, metrology, ())  # what is compiled is loaded
    return [
        {
            "effects": len(THERE) + more,
            "diagnose_s": _cpu(model, log, metrology, tuple(others[more:])),
        }
        for more in range(len(others) + 1)
    ]


def by_poses(seed: int = 3) -> list[dict[str, float]]:
    """Return the CPU time of a diagnosis with the whole catalogue by the number of poses."""
    found = []
    for poses in POSES:
        model, log, metrology = _case(poses, seed)
        found.append({"poses": poses, "diagnose_s": _cpu(model, log, metrology, ())})
    return found


def _case(poses: int, seed: int) -> tuple[Model, Log, Metrology]:
    with tempfile.TemporaryDirectory() as name:
        path, _ = write_fleet(Path(name), [[poses]], seed)
        cell = load_cell(path)
        log = read_log(next(Path(name).rglob("session-*.csv")), cell.arm.n)
    return cell.model, log, cell.metrology


def _cpu(model: Model, log: Log, metrology: Metrology, withhold: tuple[str, ...]) -> float:
    """Return the least CPU time of a diagnosis, s: what disturbs only ever adds."""
    found = []
    for _ in range(1 if len(log) >= LARGE else TURNS):
        begin = time.thread_time()
        diagnose(model, log, metrology, withhold=withhold)
        found.append(time.thread_time() - begin)
    return min(found)
