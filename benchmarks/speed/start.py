"""Starting: what a user waits for before a command does anything."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np

GAPBRIDGE = (sys.executable, "-m", "gapbridge")
COMMANDS = {
    "python, nothing": (sys.executable, "-c", "pass"),
    "gapbridge --help": (*GAPBRIDGE, "--help"),
    "import numpy": (sys.executable, "-c", "import numpy"),
    "import numba": (sys.executable, "-c", "import numba"),
    "gapbridge diagnose --help": (*GAPBRIDGE, "diagnose", "--help"),
    "gapbridge predict --help": (*GAPBRIDGE, "predict", "--help"),
    "first prediction, cache warm": (
        sys.executable, "-c",
        "import numpy as np; from gapbridge.core.arm import builtin_arm; "
        "from gapbridge.core.model import Model; "
        "Model(builtin_arm('ur10e')).predict(np.zeros((4, 6)))",
    ),
}  # fmt: skip


def start(rounds: int) -> dict[str, Any]:
    """Return the row of starting times, s; CPU time of the whole process."""
    taken: dict[str, list[tuple[float, float]]] = {name: [] for name in COMMANDS}
    for _ in range(rounds):
        for name, command in COMMANDS.items():
            busy, begin = _busy(), time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            taken[name].append((_busy() - busy, time.perf_counter() - begin))
    sides = {}
    for name, values in taken.items():
        cpu, wall = np.array(values).T
        sides[name] = {
            kind: {"median": float(np.median(v)), "min": float(v.min()),
                   "p25": float(np.percentile(v, 25)), "p75": float(np.percentile(v, 75))}
            for kind, v in (("cpu_s", cpu), ("wall_s", wall))
        }  # fmt: skip
    return {"row": "starting", "goal": "no compiler where none is needed", "sides": sides,
            "ratios": []}  # fmt: skip


def _busy() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
