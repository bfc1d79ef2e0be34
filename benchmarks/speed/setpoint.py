"""One setpoint (frames, wrenches, prediction, correction): hot, in a cold loop, in the stream."""

from __future__ import annotations

import time
from concurrent.futures import ProcessPoolExecutor
from itertools import cycle
from multiprocessing import get_context
from typing import Any

import numpy as np

from benchmarks.speed import task
from benchmarks.speed.peers import numpy_task
from benchmarks.speed.peers.casadi_task import casadi_setpoint
from benchmarks.speed.peers.cpp import Cpp, compiler
from benchmarks.speed.peers.pinocchio_task import PinocchioTask
from benchmarks.speed.sides import Call, Side, compared, interleaved
from gapbridge.bridge.loop.main import become_realtime
from gapbridge.core.compensation import Compensator
from gapbridge.core.kernels import single
from gapbridge.core.loads import Loads
from gapbridge.drivers.clock import SYSTEM

EXACT, EXACT_CALL = "ours, exact (Compensator)", "ours, exact (bare call)"
PINOCCHIO, GLUED = "Pinocchio, numpy glue", "Pinocchio, numba glue"
NUMPY, C, CASADI = "plain numpy", "C++ through ctypes", "CasADi, FunctionBuffer"
BATCH = 100  # calls in one turn


def sides() -> dict[str, Call]:
    """Return every way to compute one setpoint: ours exactly, the peers' to first order."""
    model, (q, loads) = task.deflected(), task.rows(1)
    chain, row = model.chain(), model.rows(q, loads)
    q1, wrench = q[0].copy(), row.wrench[0].copy()
    c = np.concatenate([task.AXIAL, task.RADIAL])
    pin = PinocchioTask(chain, row)
    made: dict[str, Call] = {
        **_exact(model, loads),
        PINOCCHIO: lambda: pin.setpoint(q1, wrench, c, task.DAMPING),
        GLUED: lambda: pin.setpoint_glued(q1, wrench, c, task.DAMPING),
        NUMPY: lambda: numpy_task.setpoint(chain, row, task.DAMPING),
    }
    answers = [pin.setpoint(q1, wrench, c, task.DAMPING),
               pin.setpoint_glued(q1, wrench, c, task.DAMPING),
               numpy_task.setpoint(chain, row, task.DAMPING)]  # fmt: skip
    if compiler():
        theirs = np.empty(9)
        made[C] = Cpp(chain).setpoint(q1, row, task.DAMPING, theirs)
        made[C]()
        answers.append((theirs[:6], theirs[6:]))
    buffered = casadi_setpoint(chain, row, q1, task.DAMPING)
    if buffered is not None:
        made[CASADI] = buffered[0]
        answers.append(buffered[1])
    expected_step, expected_deflection = _to_first_order(q, loads)
    for step, deflection in answers:
        np.testing.assert_allclose(step, expected_step, rtol=0, atol=1e-12)
        np.testing.assert_allclose(deflection, expected_deflection, rtol=0, atol=1e-12)
    return made


def _to_first_order(q: task.Array, loads: Loads) -> tuple[task.Array, task.Array]:
    """Return what the peers compute: a damped joint step (6,) and the TCP's deflection (3,)."""
    form = task.rigid().linear_form(q, loads)
    J = form.jacobian[0, :3]
    deflection = form.regressor[0, :3] @ np.concatenate([task.AXIAL, task.RADIAL])
    damped = J @ J.T + task.DAMPING**2 * np.eye(3)
    return -J.T @ np.linalg.solve(damped, deflection), deflection


def _exact(model: Any, loads: Loads) -> dict[str, Call]:
    """Return the exact correction along a path, one setpoint a call."""
    one, other, found = Compensator(model), Compensator(model), np.empty(12)
    there = task.path(1000)
    both = cycle([*there, *there[::-1]])  # back and forth: no jump
    again = cycle([*there, *there[::-1]])
    other.correct(there[0], loads)
    block, cog = other._block, np.zeros((1, 3))
    assert loads.wrench is not None
    mass, wrench = np.array([model.payload_mass]), loads.wrench
    return {
        EXACT: lambda: one.correct(next(both), loads),
        EXACT_CALL: lambda: single.correct(block, next(again), mass, cog, wrench, found),
    }


def _many(call: Call) -> Call:
    def run() -> None:
        for _ in range(BATCH):
            call()

    return run


def hot(rounds: int) -> dict[str, Any]:
    """Return the row of one setpoint, called again and again."""
    made = sides()
    figures = interleaved([Side(name, _many(call), BATCH) for name, call in made.items()], rounds)
    return compared("one setpoint, hot", "50 times Pinocchio with glue", figures, _pairs(made))


def _pairs(made: dict[str, Call]) -> list[tuple[str, str]]:
    peers = [name for name in (PINOCCHIO, GLUED, NUMPY, C, CASADI) if name in made]
    return [(peer, ours) for ours in (EXACT_CALL, EXACT) for peer in peers]


def cold(rounds: int) -> dict[str, Any]:
    """Return the row of one setpoint per cycle of a 500 Hz loop that sleeps in between."""
    made = sides()
    spoil = np.zeros(1 << 18)  # 2 MB: what else a cycle touches

    def after_sleep(call: Call) -> float:
        time.sleep(0.002)
        spoil[:] += 1.0
        begin = time.perf_counter()
        call()
        return time.perf_counter() - begin

    taken: dict[str, list[float]] = {name: [] for name in made}
    for _ in range(10 * rounds):
        for name, call in made.items():
            taken[name].append(after_sleep(call))
    figures = {}
    for name, values in taken.items():
        low, middle, high, most = np.percentile(values[10:], [25, 50, 75, 99])
        one = {"median": middle, "p25": low, "p75": high, "p99": most, "min": min(values),
               "all": values[10:]}  # fmt: skip
        figures[name] = {"rounds": len(values), "wall_s": one, "cpu_s": one}
    return compared(
        "one setpoint, in a 500 Hz loop", "20 times Pinocchio with glue", figures, _pairs(made)
    )


def stream(rounds: int) -> dict[str, Any]:
    """Return what the daemon's stream takes: state in, setpoint out, the limiter included.

    In a process that is made ready as the daemon's loop is: real-time priority, no collection.
    """
    with ProcessPoolExecutor(1, get_context("spawn"), become_realtime, (0.002,)) as alone:
        return alone.submit(_stream, rounds).result()


def _stream(rounds: int) -> dict[str, Any]:
    from gapbridge.bridge.cell.sections import LimitSettings
    from gapbridge.bridge.loop.setpoint_stream import SetpointStream
    from gapbridge.core.state import RobotState

    made = SetpointStream(task.deflected(), LimitSettings(), 500.0, clock=SYSTEM)
    there, (_, loads) = task.path(500 * rounds), task.rows(1)
    made.start(there[0], 0.0, led=True)
    taken: dict[str, list[float]] = {"wall": [], "cpu": []}
    missed, begin = 0, time.perf_counter()
    for k in range(1, len(there)):
        deadline = begin + 0.002 * k
        time.sleep(max(deadline - time.perf_counter(), 0.0))
        state = RobotState(
            timestamp=0.002 * k, received=0.002 * k, actual_q=there[k - 1],
            target_q=there[k - 1], actual_qd=np.zeros(6), actual_TCP_force=np.zeros(6),
        )  # fmt: skip
        wall, busy = time.perf_counter(), time.thread_time()
        made.advance(state, there[k], loads, 1.0)
        taken["cpu"].append(time.thread_time() - busy)
        taken["wall"].append(time.perf_counter() - wall)
        missed += time.perf_counter() > deadline + 0.002
    found = {
        kind: dict(zip(("median", "p90", "p99", "p99_9"),
                       np.percentile(values, [50, 90, 99, 99.9]), strict=True))
        for kind, values in taken.items()
    }  # fmt: skip
    return {
        "row": "the same through the daemon's stream", "goal": "p99 under 50 us",
        "sides": {"SetpointStream.advance": {"wall_s": found["wall"], "cpu_s": found["cpu"]}},
        "ratios": [], "cycles": len(there) - 1, "missed_cycles": missed,
    }  # fmt: skip
