"""How long a diagnosis takes, and where its time goes: cases of the blind benchmark."""

from __future__ import annotations

import cProfile
import pstats
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.blind.cases import make_case
from gapbridge.bridge.cell import load_cell
from gapbridge.core.diagnosis.diagnosis import diagnose
from gapbridge.core.log.log import Log, read_log
from gapbridge.core.model import Model

CASES = ("pair", "triple", "torque:pair", "tracking:pair")
SHARES = {
    "prediction (block kernels)": ("core/kernels/many.py", ("predict", "linear_form")),
    "rows and chains of the model": ("core/model.py", ("rows", "chain")),
    "least squares (lstsq, svd, qr, solve)": ("numpy/linalg", ("lstsq", "svd", "qr", "solve")),
    "torques (recursive Newton-Euler)": ("core/dynamics.py", ()),
    "derivatives of signals": ("core/derivatives.py", ("differentiate",)),
    "splines": ("core/kernels/interpolation.py", ("interpolate",)),
}


def diagnosis(seed: int = 1) -> dict[str, Any]:
    """Return the row of the diagnoses: CPU time of each case, and shares of a profile."""
    sides, profiles = {}, {}
    for kind in CASES:
        with tempfile.TemporaryDirectory() as folder:
            make_case(kind, seed, Path(folder))
            cell = load_cell(Path(folder) / "cell.yaml")
            log = read_log(Path(folder) / "log.csv", cell.arm.n)
        name = f"{kind}, {len(log)} rows"
        times = []
        for _ in range(2):  # the first one loads what is compiled
            wall, busy = time.perf_counter(), time.thread_time()
            diagnose(cell.model, log, cell.metrology)
            times.append((time.perf_counter() - wall, time.thread_time() - busy))
        sides[name] = {
            "wall_s": {"median": times[1][0]}, "cpu_s": {"median": times[1][1]},
            "first_s": times[0][1],
        }  # fmt: skip
        profiles[name] = _profile(cell.model, log, cell.metrology)
    return {
        "row": "diagnosis", "goal": "70 poses: 2 s; 30 s at 500 Hz: 10 s", "sides": sides,
        "ratios": [], "profile": profiles,
    }  # fmt: skip


def _profile(model: Model, log: Log, metrology: Any) -> dict[str, Any]:
    profile = cProfile.Profile(time.thread_time)
    profile.runcall(diagnose, model, log, metrology)
    stats: Any = pstats.Stats(profile)
    total = stats.total_tt
    own = sorted(
        ((row[2], row[0], f"{Path(file).parent.name}/{Path(file).name}:{name}")
         for (file, _, name), row in stats.stats.items()), reverse=True,
    )[:12]  # fmt: skip
    shares = {}
    for what, (place, names) in SHARES.items():
        shares[what] = sum(
            row[3] for (file, _, name), row in stats.stats.items()
            if place in file and (name in names)
        ) / total  # fmt: skip
    return {
        "seconds_profiled": total,
        "shares_cumulative": {what: round(share, 3) for what, share in shares.items() if share},
        "own_time": [
            {"share": round(seconds / total, 3), "calls": calls, "function": name}
            for seconds, calls, name in own
        ],
    }
