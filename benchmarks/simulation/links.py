"""The links, with a controller and wires in memory; the drivers are the product's own."""

from __future__ import annotations

import functools
import itertools
import math
import random
import shutil
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.faults.invariants import Bounds
from benchmarks.faults.wire.seen import Fresh, Numbers, Write
from benchmarks.simulation.cells import CELLS
from benchmarks.simulation.wires import Wire
from benchmarks.simulation.world import SimulatedClock, World
from gapbridge.bridge.cell import Cell, load_cell
from gapbridge.bridge.cell.run_settings import (
    Configuration,
    configuration_for,
    read_configuration,
    settings_of,
)
from gapbridge.core.errors import GapbridgeError
from gapbridge.core.state import RobotState
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.plant.kinematics import Joints
from gapbridge.drivers.simulated.server.arm_controller import ArmController, make_controller
from gapbridge.drivers.simulated.ur.settings import simulated_arm

PAYLOAD: dict[str, tuple[float, tuple[float, float, float]]] = {
    "can": (1.0, (0.0, 0.0, 0.06)), "odrive": (6.0, (0.0, 0.0, 0.05)),
    "openarm": (1.0, (0.0, 0.0, 0.05)),
}  # kg, m  # fmt: skip
UR_PAYLOAD = (5.0, (0.0, 0.0, 0.06))
SIMULATED_RATE = {
    "ur_servoj": 125.0, "ur_offset": 125.0, "modbus": 50.0, "can": 100.0, "canopen": 100.0,
    "ur_sensor": 125.0, "odrive": 100.0, "openarm": 50.0,
    "modbus_target": 50.0,
}  # Hz  # fmt: skip
SENSED_EVERY = 4  # cycles
RESTARTS = (0.05, 0.4)  # s: the daemon's backoff
Saw = Callable[[Fresh | Write], None]
AnyDriver = TypeVar("AnyDriver", bound=Driver)


class Setting:
    """What all runs of a link share: its cell and its profile, read once."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._profile: Any = None
        self._again: dict[str, Configuration | GapbridgeError] = {}
        self.wired = CELLS[name](SIMULATED_RATE[name])
        self._folder = tempfile.TemporaryDirectory(prefix="simulation-")
        path, _ = self.wired.write_cells(Path(self._folder.name), "127.0.0.9", "127.0.0.9", "")
        shutil.copymode(path, path)
        self.cell: Cell = load_cell(path)
        settings = settings_of(self.cell).model_copy(
            update={"backoff": RESTARTS, "hang_timeout": 1.0}
        )
        self.configuration: Configuration = configuration_for(settings)
        self.bounds: Bounds = self.wired.bounds(path)
        mass, cog = PAYLOAD.get(name, UR_PAYLOAD)
        tcp = (*self.cell.file.tool.tcp.xyz, 0.0, 0.0, 0.0)
        self.arm = simulated_arm(
            self.cell.arm, 11, self.wired.start_q, payload_mass=mass, payload_cog=cog, tcp=tcp
        )

    def _read_text(self, text: str) -> Configuration | GapbridgeError:
        path = self.cell.path
        before = path.read_text(encoding="utf-8")
        path.write_text(text, encoding="utf-8")
        try:
            return read_configuration(path)
        except GapbridgeError as error:
            return error
        finally:
            path.write_text(before, encoding="utf-8")

    def read_again(self, kind: str) -> Configuration:
        """Return what the cell file comes to: "same", "narrow" or "wrong". Raises InputError."""
        if not self._again:
            text = self.cell.document.text
            self._again = {
                "same": self._read_text(text),
                "narrow": self._read_text(text.replace("offset: 0.002", "offset: 0.00005")),
                "wrong": self._read_text(text.replace("offset_rate: ", "offset_rate: -")),
            }
        found = self._again[kind]
        if isinstance(found, GapbridgeError):
            raise found
        return found

    def make_driver(self, module: Any, kind: type[AnyDriver], clock: SimulatedClock) -> AnyDriver:
        """Return the driver of a new process; ``module`` is the one that reads its profile."""
        read = module.read_profile

        def read_once(*given: Any) -> Any:
            if self._profile is None:
                self._profile = read(*given)
            return self._profile

        module.read_profile = read_once
        try:
            made: Any = kind
            found: AnyDriver = made(self.cell.link, self.cell.model, clock)
        finally:
            module.read_profile = read
        return found


@functools.cache
def setting_of(name: str) -> Setting:
    """Return what all runs of a link share."""
    return Setting(name)


def _sense_seldom(controller: ArmController) -> None:
    """Have forces and poses be measured anew in some cycles only: they cost most of the arm."""
    sense, cycles = controller.sensors.update, itertools.count(1)

    def seldom(target_q: Joints, dt: float) -> None:
        if next(cycles) % SENSED_EVERY == 0:
            sense(target_q, SENSED_EVERY * dt)

    controller.sensors.update = seldom  # type: ignore[method-assign]


class SimulatedLink(ABC):
    """One controller, its wires, and the driver's edge to them.

    ``saw`` is called with each state as it reaches the client and each write as it leaves it.
    """

    looks_again = False  # at a setpoint's age, after write_setpoint

    def __init__(self, world: World, clock: SimulatedClock, setting: Setting, saw: Saw) -> None:
        self.world, self.clock, self.setting, self.saw = world, clock, setting, saw
        self.period = 1.0 / setting.wired.rate
        self.controller: ArmController = make_controller(*setting.arm, self.period)
        _sense_seldom(self.controller)
        self.up: Wire[Any] = Wire(world, self._on_up)  # from the client
        self.down: Wire[Any] = Wire(world, self._on_down)
        self.pace = 1.0  # of the controller's clock
        self.pace_of_cycles = 1.0  # of a controller without a clock that says so
        self.paused_until = 0.0  # the robot's program stands still
        self.rebooting_until = 0.0
        self.refuses_until = 0.0  # no new connection before
        self.freezes_values = False
        self.supervisor_state: Callable[[], int] = lambda: -1
        self.sends = False  # between the last look at a setpoint's age and its leaving
        self.hidden_leap = 0.0  # s, on this connection: see UrLink
        self._sampled: dict[float, float] = {}  # by what a driver stamps its state with -> truth, s
        world.every(lambda: self.period / self.pace_of_cycles, self._tick)

    # -- what the client sees ---------------------------------------------------------------------

    def see(
        self, fresh: tuple[float, Sequence[float], Sequence[float], bool], bare: bool = False
    ) -> None:
        """Report a state that has reached the client: controller's clock, joints, target, safe.

        ``bare``: the robot's program says in it that it applies no offset.
        """
        stamp, q, target, safe = fresh
        now, state = self.world.now, self.supervisor_state()
        self.saw(Fresh(now, stamp, tuple(q), tuple(target), safe, True, state, bare=bare))

    def wrote(self, kind: Any, values: Numbers, where: str) -> None:
        """Report a write that leaves the client. Raises KilledError where that is dead."""
        process = self.world.current
        if process is not None:
            process.check()
        if kind == "other":  # no part of what must hold
            return
        self.sends = False
        self.saw(Write(self.world.now, kind, values, where, self.supervisor_state()))

    @property
    def reachable(self) -> bool:
        """Return whether a new connection comes about."""
        return self.world.now >= max(self.rebooting_until, self.refuses_until)

    def sampled_at(self, state: RobotState) -> float:
        """Return when the controller sampled a state, s of the world; NaN where nobody knows."""
        return self._sampled.get(self.key_of(state), math.nan)

    def key_of(self, state: RobotState) -> float:
        """Return what a state is known again by."""
        return state.timestamp

    @abstractmethod
    def driver(self) -> Driver:
        """Return the product's driver, its edge being this link's wires; for a new process."""

    @abstractmethod
    def publish(self) -> None:
        """Send what the controller sends in a cycle."""

    @abstractmethod
    def _on_up(self, message: Any) -> None: ...

    @abstractmethod
    def _on_down(self, message: Any) -> None: ...

    # -- the controller ---------------------------------------------------------------------------

    def _tick(self) -> None:
        controller, now = self.controller, self.world.now
        if now < self.rebooting_until or controller.stalled:
            controller.running += self.period
            return
        controller.period = self.period * self.pace
        controller.cycle()
        controller.period = self.period
        self.cycle()
        self.publish()

    def cycle(self) -> None:
        """Run the robot's side of the link."""

    def restart(self, seconds: float) -> None:
        """Have the controller start anew: its clock too; connections are lost."""
        self.rebooting_until = self.world.now + seconds
        self.controller.clock = 0.0
        self.disconnect()
        self.forget_client()

    def disconnect(self) -> None:
        """Break every connection."""
        self.up.cut()
        self.down.cut()

    def reconnected(self) -> None:
        """Have wires carry again: a client has connected."""
        self.hidden_leap = 0.0
        self.up.is_cut = self.down.is_cut = False

    def forget_client(self) -> None:
        """Have the controller forget all that clients sent it."""
        self.controller.let_go()

    def heal(self) -> None:
        """Do what a person does until robot and network are as they were."""
        cut = self.up.is_cut
        self.up.heal()
        self.down.heal()
        self.up.is_cut = self.down.is_cut = cut  # connections do not come back by themselves
        controller = self.controller
        controller.frozen, self.freezes_values = False, False
        self.pace = self.pace_of_cycles = 1.0
        self.leave_mode()
        controller.release_emergency_stop()
        controller.unlock()
        self.refuses_until = self.paused_until = 0.0
        self.declare(self.setting.arm[1].payload_mass)

    @abstractmethod
    def enter_mode(self, draw: random.Random) -> str:
        """Have the robot be in a mode in which it does not move; returns it in words."""

    @abstractmethod
    def leave_mode(self) -> None:
        """Have the robot be ready to move again; its program may have ended."""

    @property
    def is_paused(self) -> bool:
        """Return whether the robot's program stands still."""
        return self.world.now < self.paused_until

    def declare(self, mass: float) -> None:
        """Declare another payload in the controller, kg."""
        self.controller.declared.payload_mass = mass

    def foreign(self, seconds: float) -> None:
        """Have somebody else command the arm, as far as the link lets them."""
