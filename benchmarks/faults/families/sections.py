"""Faults that need a cell of their own: sources, limits, models, sensors, disks, cell files."""

from __future__ import annotations

import json
import resource
import shutil
import socket
import tempfile
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from benchmarks.faults.bad_model import FLAG
from benchmarks.faults.links import LIMITS, Link
from benchmarks.faults.rig import Rig
from benchmarks.faults.row import Row, cycles, seconds
from benchmarks.ports import own_host
from gapbridge.bridge.cell import load_cell
from gapbridge.drivers.can_bus.bus import BusSettings
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.hub import Hub
from gapbridge.drivers.simulated.ft_sensor.ati_node import RobotousNode

MOVING, GOES_ON = ("ur_servoj", "can"), ("compensating",)
ROOM = 0.02  # rad that a joint has to its limit where a planner is to go beyond it
LINE = 0.02  # s between two lines of a planner
WEIGHT = (0.0, 0.0, 49.0, 0.0, 0.0, 0.0)  # N


class PlannedRig(Rig):
    """A rig whose setpoints come from a planner, which keeps the arm where it is."""

    goal: list[float]

    def __init__(self, link: Link, folder: Path) -> None:
        self._socket = Path(tempfile.mkdtemp()) / "planner.sock"  # a short path, as sockets need
        arm_q, self.joint, self.way, margin, self._fastest = self._nearest_limit(link, folder)
        limits = LIMITS.replace("ramp_time", f"joint_margin: {margin:.4f}\n  ramp_time")
        setpoints = f"setpoints: {{source: planner, socket: {self._socket}}}\n"
        super().__init__(link, folder, limits + setpoints)
        self.goal, self._over = arm_q, threading.Event()
        self._planner = threading.Thread(target=self._plan, daemon=True, name="planner")

    @staticmethod
    def _nearest_limit(link: Link, folder: Path) -> tuple[list[float], int, float, float, float]:
        """Return where the arm stands, the joint nearest to its limit, which way, and a margin.

        The last is how fast the joint may be, rad/s.
        """
        cell, _ = link.write_cells(folder, "127.0.0.1", "127.0.0.1", "")
        arm = load_cell(cell).arm
        q = np.array(link.start_q)
        up, down = arm.limits.upper - q, q - arm.limits.lower
        joint = int(np.argmin(np.minimum(up, down)))
        way = 1.0 if up[joint] < down[joint] else -1.0
        room, fastest = min(up[joint], down[joint]), arm.limits.velocity[joint]
        return q.tolist(), joint, way, float(room) - ROOM, float(fastest)

    def __enter__(self) -> Self:
        self._planner.start()
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._over.set()
        super().__exit__(kind, error, trace)
        shutil.rmtree(self._socket.parent, ignore_errors=True)

    def _plan(self) -> None:
        while not self._over.wait(0.1):
            try:
                with socket.socket(socket.AF_UNIX) as link:
                    link.settimeout(1.0)
                    link.connect(str(self._socket))
                    while not self._over.wait(LINE):
                        link.sendall((json.dumps({"q": self.goal}) + "\n").encode())
            except OSError:
                continue  # no loop listens just now

    def leap(self, by: float) -> None:
        """Ask for a setpoint that is too far away, and then again for where the arm stands.

        On its way there it is followed for as long as it is no faster than the joint may be, and
        then it brakes: the plan's motion, and no offset.
        """
        self.checker.leave_to_plan(self.joint)
        home = list(self.goal)
        self.goal = [q + by * (i == self.joint) for i, q in enumerate(home)]
        self.pass_time(0.1)
        self.goal = home


def _beyond(rig: Rig) -> None:
    assert isinstance(rig, PlannedRig)
    rig.leap(0.8 * rig.way)


def _jump(rig: Rig) -> None:
    assert isinstance(rig, PlannedRig)
    rig.leap(-1.5 * rig.way)


class SensedRig(Rig):
    """A rig with a force-torque sensor on a bus of its own."""

    def __init__(self, link: Link, folder: Path, when_lost: str) -> None:
        self._hub = Hub(SYSTEM, own_host())
        self._hub.__enter__()
        bus = BusSettings(interface="socketcand", host=self._hub.host, port=self._hub.port)
        self.sensor = RobotousNode(lambda: WEIGHT, bus, SYSTEM)
        super().__init__(link, folder, (
            f"{LIMITS}ft_sensor: {{driver: robotous_rft, interface: socketcand, "
            f"host: {self._hub.host}, port: {self._hub.port}, max_age: 0.1, "
            f"when_lost: {when_lost}}}\n"
        ))  # fmt: skip

    def __enter__(self) -> Self:
        self.sensor.__enter__()
        return super().__enter__()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        super().__exit__(kind, error, trace)
        self.sensor.__exit__(kind, error, trace)
        self._hub.__exit__(kind, error, trace)


def _silence_sensor(rig: Rig) -> None:
    assert isinstance(rig, SensedRig)
    rig.sensor.silent = True


def _restore_sensor(rig: Rig) -> None:
    assert isinstance(rig, SensedRig)
    rig.sensor.silent = False


def _no_number(rig: Rig) -> None:
    (rig.cell.parent / FLAG).touch()


def _numbers_again(rig: Rig) -> None:
    (rig.cell.parent / FLAG).unlink()


def _limit_disk(size: int) -> Any:
    """Return an injection: the system refuses what the recorder writes beyond ``size`` bytes."""

    def inject(rig: Rig) -> None:
        pid = rig.run.daemon.side_processes.status()["recorder"]["pid"]
        assert pid is not None
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

    return inject


def _bad_reload(rig: Rig) -> None:
    good = rig.cell.read_text(encoding="utf-8")
    rig.cell.write_text(good.replace("offset_rate: ", "offset_rate: -"), encoding="utf-8")
    before = len(rig.run.events)
    rig.run.daemon.reload()
    until = time.monotonic() + 5.0
    while time.monotonic() < until and len(rig.run.events) == before:
        rig.pass_time(0.01)
    rig.cell.write_text(good, encoding="utf-8")


SMALL = LIMITS.replace("offset: 0.002", "offset: 0.00005")
RECORDED = LIMITS.replace("folder: null", "folder: recordings")

ROWS = (
    Row("setpoint beyond a limit", "setpoint beyond a joint limit", "a planner sends one",
        _beyond, MOVING, within=seconds(0.3), own=PlannedRig),
    Row("setpoint jumps", "setpoint > v_max dt away", "a planner sends one 1.5 rad away",
        _jump, MOVING, within=seconds(0.3), own=PlannedRig),
    Row("saturation", "offset limit reached for 1 s", "the cell allows 0.05 mm, less than needed",
        lambda rig: None, within=seconds(1.6),
        own=lambda link, folder: Rig(link, folder, SMALL)),
    Row("bad model output", "compensation output NaN", "the model's correction becomes NaN",
        _no_number, within=cycles(3, 0.1), lasting=0.1, end=("fault",), after=_numbers_again,
        own=lambda link, folder: Rig(
            link, folder, model_source="benchmarks.faults.bad_model:load_cell")),
    Row("sensor lost, degrade", "FT sensor lost", "the sensor falls silent for 0.5 s",
        _silence_sensor, ("ur_servoj",), "sensor_lost", seconds(0.4), GOES_ON, 0.5,
        own=lambda link, folder: SensedRig(link, folder, "degrade"), after=_restore_sensor),
    Row("sensor lost, stop", "FT sensor lost", "the sensor falls silent, when_lost: stop",
        _silence_sensor, ("ur_servoj",), within=seconds(0.5), end=("observing", "fault"),
        lasting=0.1, own=lambda link, folder: SensedRig(link, folder, "stop"),
        after=_restore_sensor),
    Row("disk full", "disk full", "the system refuses what the recorder writes",
        _limit_disk(2000), sign="event:recorder paused", within=seconds(4.0), end=GOES_ON,
        lasting=0.5, own=lambda link, folder: Rig(link, folder, RECORDED),
        after=_limit_disk(resource.RLIM_INFINITY)),
    Row("bad reload", "config invalid at reload", "SIGHUP with a cell file that is wrong",
        _bad_reload, sign="event:configuration", within=seconds(3.0), end=GOES_ON),
)  # fmt: skip
