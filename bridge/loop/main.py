"""The loop's process: ``python -m gapbridge.bridge.loop.main``, started by the daemon alone.

It runs the loop and one driver, and may be killed: the robot's library can abort, crash or hang it.
Settings come as one line of JSON on stdin, requests through memory that only the daemon writes to;
cycles are published in shared memory, events as JSON over a socket. It always ends by ``os._exit``,
because destroying the library's objects is not safe.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import pickle
import signal
import struct
import sys
import traceback
from collections.abc import Callable
from pkgutil import resolve_name
from typing import Any

import numpy as np

from gapbridge.bridge.cell.daemon_settings import DaemonSettings
from gapbridge.bridge.cell.sections import SetpointSettings
from gapbridge.bridge.ipc.command_memory import Commands
from gapbridge.bridge.ipc.events import EventKind
from gapbridge.bridge.ipc.sealed_memory import all_bytes
from gapbridge.bridge.ipc.shared_memory import Phase, SharedMemory
from gapbridge.bridge.loop.claimed_controller import claimed_controller
from gapbridge.bridge.loop.loop import Exit, Loop
from gapbridge.bridge.loop.replay import ReplayedLoop
from gapbridge.bridge.loop.setpoint_stream import SetpointStream, gate_bounds
from gapbridge.bridge.setpoint_source import make_source
from gapbridge.bridge.setpoint_source.source import Source
from gapbridge.core.errors import GapbridgeError, InputError
from gapbridge.core.files import read_only_given
from gapbridge.core.kernels import compiling
from gapbridge.core.loads import Loads
from gapbridge.core.model import Model
from gapbridge.drivers import make_driver
from gapbridge.drivers.clock import SYSTEM, Clock
from gapbridge.drivers.controller_address import address_of
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor.joined import DriverWithSensor
from gapbridge.drivers.replay.driver import ReplayDriver

TIMER_SLACK = 29  # prctl's PR_SET_TIMERSLACK
SLACK = 1000  # ns
PRIORITY = 30  # SCHED_FIFO: below interrupt threads (50) and a simulated controller (40)
LOCK_ALL = 3  # MCL_CURRENT | MCL_FUTURE
LATENCY = "/dev/cpu_dma_latency"  # the kernel's PM QoS interface
IDLE_DRIVER = "/sys/devices/system/cpu/cpuidle/current_driver"  # the kernel's idle driver
FAST = 0.005  # s: loops with this cycle or a shorter one keep the processors awake
_open_files: list[int] = []  # kept open to the end: closing one would undo its effect
_PR_SET_PDEATHSIG = 1
LONGEST_DETAIL = 1000  # of an event


def main() -> None:
    """Run the loop; never returns."""
    order = json.loads(sys.stdin.readline())
    os.set_blocking(order["events"], False)
    emit = _emitter(order["events"], SYSTEM)
    compiling.listeners.append(_report_compiling(emit))
    code: int = Exit.CRASH
    try:
        code = _run(order, emit, SYSTEM)
    except InputError as error:
        emit({"kind": EventKind.FAILURE, "detail": str(error), "input": True})
        code = Exit.INPUT
    except GapbridgeError as error:
        emit({"kind": EventKind.FAILURE, "detail": str(error)})
        code = Exit.LINK
    except BaseException as error:
        traceback.print_exc()
        detail = f"the loop failed: {type(error).__name__}: {error}"
        emit({"kind": EventKind.FAILURE, "detail": detail})
    sys.stderr.flush()
    become_ordinary()
    os._exit(code)


def _run(order: dict[str, Any], emit: Callable[[dict[str, Any]], None], clock: Clock) -> Exit:
    memory = SharedMemory(order["n"], order["memory"], clock=clock)
    memory.enter(Phase.STARTING)
    files = pickle.loads(all_bytes(order["files"]))  # by the daemon, which started this process
    read_only_given(files)  # only the daemon reads the disk, at start and reload
    settings = DaemonSettings.model_validate(order["settings"])
    _end_with_parent(order["parent"])
    if sys.platform.startswith("linux"):  # before anything looks at what is in force in the arm
        claimed = claimed_controller(address_of(settings.link), emit, clock)
        _open_files.append(claimed.detach())
        memory.enter(Phase.STARTING)  # what it has waited does not count as silence
    model = _read_model(settings)
    driver = make_driver(settings.link, model, gate_bounds(settings.limits), clock)
    source = _make_source(settings, model, driver)
    loop = _make_loop(settings, model, driver, source, memory, emit, order["number"])
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: loop.request_stop())
    _compile(settings, model, clock)
    if order["may_write"]:
        source.open()
    granted = ", ".join(become_realtime(1.0 / driver.rate))
    emit({"kind": EventKind.GRANTED, "hash": order["hash"], "detail": granted})
    commands = Commands(order["commands"], order["after"])
    return loop.run(commands, order["may_write"], order["latched"])


def _make_source(settings: DaemonSettings, model: Model, driver: Driver) -> Source:
    """Return the setpoint source; a recording needs none."""
    is_replay = isinstance(driver, ReplayDriver)
    setpoints = SetpointSettings() if is_replay else settings.setpoints
    return make_source(
        setpoints, model.arm.n, driver.moves_arm, settings.cell.parent, driver.clock, driver.rate
    )


def _make_loop(
    settings: DaemonSettings, model: Model, driver: Driver, source: Source, *arguments: Any
) -> Loop:
    """Return the loop of a link; a recording contains the sensor's readings."""
    if isinstance(driver, ReplayDriver):
        return ReplayedLoop(settings, model, driver, source, *arguments)
    if settings.ft_sensor is not None:
        driver = DriverWithSensor(driver, settings.ft_sensor, model)
    return Loop(settings, model, driver, source, *arguments)


def _emitter(events: int, clock: Clock) -> Callable[[dict[str, Any]], None]:
    """Return a function that notifies the daemon of an event and never blocks."""

    def emit(event: dict[str, Any]) -> None:
        if len(event.get("detail", "")) > LONGEST_DETAIL:
            event = {**event, "detail": event["detail"][:LONGEST_DETAIL]}
        now = {"time": clock.time(), "monotonic": clock.monotonic()}
        with contextlib.suppress(OSError):  # one datagram: sent completely or not at all
            os.write(events, json.dumps({**now, **event}).encode())

    return emit


def _report_compiling(emit: Callable[[dict[str, Any]], None]) -> Callable[[int], None]:
    """Return a listener that notifies the daemon of the first function and every tenth."""

    def began(functions: int) -> None:
        if functions % 10 == 1:
            far = "" if functions == 1 else f" ({functions} functions)"
            emit({"kind": EventKind.COMPILING, "detail": f"starting: {compiling.ABOUT}{far}"})

    return began


def _read_model(settings: DaemonSettings) -> Model:
    model = resolve_name(settings.model_source)(settings.cell).model
    if not isinstance(model, Model):
        raise InputError(f"{settings.model_source}: found {type(model).__name__}, expected a Model")
    return model


def _compile(settings: DaemonSettings, model: Model, clock: Clock) -> None:
    """Compile or load all kernels before the first cycle; may take seconds."""
    arm = model.arm
    stream = SetpointStream(model, settings.limits, settings.link.rate, clock)
    q = np.clip(np.zeros(arm.n), arm.limits.lower, arm.limits.upper)
    loads = Loads(
        np.zeros(1), np.zeros((1, 3)), np.zeros((1, 6)), np.full((1, arm.n), 25.0),
        np.zeros((1, arm.n)),
    )  # fmt: skip
    correction = stream.correct(q, loads)
    with contextlib.suppress(GapbridgeError):
        stream.limiter.start(q)
        stream.limiter.limit(q, correction.q, correction.offset_in_base, 0.0, q, 0.002)
    gc.collect()


def _end_with_parent(parent: int) -> None:
    """Have the kernel send SIGTERM when the daemon dies, so that the loop ramps out and ends.

    Before there is a loop, SIGTERM ends the process at once.
    """
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(Exit.DONE)


def become_realtime(cycle: float) -> list[str]:
    """Prepare this thread, and those it starts from now on; returns the measures granted.

    ``cycle`` is that of the loop, s. Afterwards Python collects no garbage by itself.
    """
    granted = []
    sys.setswitchinterval(1e-4)
    with contextlib.suppress(OSError, AttributeError):
        if ctypes.CDLL(None).prctl(TIMER_SLACK, SLACK, 0, 0, 0) == 0:
            granted.append("timer slack")
    if _may_lock():
        with contextlib.suppress(OSError, AttributeError):
            if ctypes.CDLL(None).mlockall(LOCK_ALL) == 0:
                granted.append("locked memory")
    if cycle <= FAST and _keep_awake():
        granted.append("processors awake")
    gc.collect()
    gc.freeze()
    gc.disable()
    # last: with priority, locking memory would block this processor for some 100 ms
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
        granted.append("real-time priority")
    return granted


def become_ordinary() -> None:
    """Drop real-time priority: freeing this process's memory takes long."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def _keep_awake() -> bool:
    """Keep idle processors out of sleep states until this process ends; returns whether they are.

    A sleeping processor wakes late and with cold caches; awake it takes more power. Only root may
    request it, unless others may write to LATENCY. Without a cpuidle driver, as in many virtual
    machines, the request has no effect.
    """
    with contextlib.suppress(OSError):
        with open(IDLE_DRIVER, encoding="ascii") as kinds:
            if kinds.read().strip() in ("", "none"):
                return False
        file = os.open(LATENCY, os.O_WRONLY | os.O_CLOEXEC)
        _open_files.append(file)
        return os.write(file, struct.pack("@i", 0)) > 0  # us until a processor must be awake
    return False


def _may_lock() -> bool:
    """Return whether locked memory is unlimited: with a limit, allocations would fail later."""
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
        return os.geteuid() == 0 or limit == resource.RLIM_INFINITY
    except (ImportError, AttributeError, OSError):
        return False


if __name__ == "__main__":
    main()
