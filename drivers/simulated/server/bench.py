"""The bench on port 30100: the actions of a person and a laser tracker at a real cell.

One command a line, one line back; `help` lists them. None of it is known to the controller.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from gapbridge.drivers.simulated.plant.kinematics import pose_of
from gapbridge.drivers.simulated.plant.plant import Plant
from gapbridge.drivers.simulated.plant.plant_arm import place
from gapbridge.drivers.simulated.plant.rotations import compose, from_vector, to_vector
from gapbridge.drivers.simulated.server.connection import Connection

if TYPE_CHECKING:
    from gapbridge.drivers.simulated.plant.plant_arm import Frame


HEAVIEST = 200.0  # kg
FARTHEST = 10.0  # m, of a payload's centre of gravity
STRONGEST = 1e4  # N, Nm
LONGEST_LINE = 1000  # characters

Joints = tuple[float, ...]
Command = tuple[int, Callable[[list[float]], str | None], str]
"""Number of arguments of a command, its function (None: the answer is ok), its help text."""


class BenchError(ValueError):
    """A command that cannot be executed; the message is sent back."""


class BenchSubject(Protocol):
    """The controller of the bench: a UR controller or an ArmController."""

    plant: Plant
    memory: dict[str, Any]
    largest_servo_step: float

    def freeze(self, frozen: bool) -> None:
        """Stop the clock, or let it go on."""
        ...

    def stall(self, seconds: float) -> None:
        """Send and answer nothing for a while."""
        ...

    def protective_stop(self) -> None:
        """Stop as after a collision."""
        ...

    def unlock(self) -> None:
        """Clear a protective stop."""
        ...

    def emergency_stop(self) -> None:
        """Stop as after a push of the button."""
        ...

    def release_emergency_stop(self) -> None:
        """Release the button."""
        ...


class BenchServer:
    """Answers bench commands on one plant.

    `move_own` has the robot's own program move to joints (n, rad) and raises BenchError where it
    cannot; `further` commands are those of one protocol.
    """

    def __init__(
        self,
        controller: BenchSubject,
        drop_clients: Callable[[], None],
        move_own: Callable[[Joints], None],
        more_commands: Mapping[str, Command] | None = None,
    ) -> None:
        self._controller = controller
        self._random = np.random.default_rng((controller.plant.settings.seed, 2))
        n = len(controller.plant.q)
        self._commands: dict[str, Command] = {
            "measure": (0, self._measure, "timestamp,x,y,z,rx,ry,rz of the true TCP, with noise"),
            "payload": (4, self._payload, "MASS CX CY CZ: hang a load on the flange, kg, m"),
            "wrench": (6, self._wrench, "FX FY FZ TX TY TZ: pull at the TCP, base axes, N, Nm"),
            "slip": (2, self._slip, "JOINT ANGLE: the joint's zero slips by ANGLE, rad"),
            "move": (n, lambda q: move_own(tuple(q)),
                     f"Q1..Q{n}: the robot's own program moves there, rad"),
            "protective_stop": (0, lambda _: controller.protective_stop(), "as a collision would"),
            "emergency_stop": (0, lambda _: controller.emergency_stop(), "press the button"),
            "release": (0, lambda _: controller.release_emergency_stop(),
                        "release the emergency stop button"),
            "unlock": (0, lambda _: controller.unlock(),
                       "clear a protective stop, after a look at its cause"),
            "freeze": (0, lambda _: controller.freeze(True),
                       "the controller's clock stands still, packets go on"),
            "thaw": (0, lambda _: controller.freeze(False), "the clock goes on"),
            "stall": (1, lambda arguments: controller.stall(max(arguments[0], 0.0)),
                      "SECONDS: the controller sends and answers nothing"),
            "drop": (0, lambda _: drop_clients(), "close every client's connection"),
            "truth": (0, self._truth, "the hidden plant as JSON, for scoring only"),
            "help": (0, self._help, "this list"),
            **(more_commands or {}),
        }  # fmt: skip

    def handle(self, connection: Connection) -> None:
        """Answer every complete line."""
        for line in connection.lines():
            connection.send(self.answer(line).encode() + b"\n")

    def answer(self, line: str) -> str:
        """Return the reply to one command; a mistake is reported as ``error: ...``."""
        name, *arguments = line[:LONGEST_LINE].split()
        try:
            if name not in self._commands:
                raise BenchError(f"unknown command {name!r}, try help")
            count, action, _ = self._commands[name]
            return action(_numbers(name, arguments, count)) or "ok"
        except BenchError as error:
            return f"error: {error}"

    # -- the tracker ------------------------------------------------------------------------------

    def _measure(self, _: list[float]) -> str:
        controller = self._controller
        s = controller.plant.settings
        tcp = controller.plant.true_tcp()
        shift = self._random.normal(0.0, s.tracker_noise, 3)
        turn = self._random.normal(0.0, s.tracker_rotation_noise, 3)
        position = [a + float(b) for a, b in zip(tcp.origin, shift, strict=True)]
        rotation = to_vector(compose(from_vector([float(v) for v in turn]), tcp.rotation))
        values = (controller.memory["timestamp"], *position, *rotation)
        return ",".join(f"{v:.9g}" for v in values)

    # -- hands ------------------------------------------------------------------------------------

    def _payload(self, numbers: list[float]) -> None:
        mass, x, y, z = numbers
        if not 0.0 <= mass <= HEAVIEST:
            raise BenchError(f"payload: found {mass:g} kg, expected 0 to {HEAVIEST:g}")
        _check_size("payload", (x, y, z), FARTHEST, "m")
        self._controller.plant.set_load(mass, (x, y, z))

    def _wrench(self, numbers: list[float]) -> None:
        fx, fy, fz, tx, ty, tz = numbers
        _check_size("wrench", numbers, STRONGEST, "N or Nm")
        self._controller.plant.set_force((fx, fy, fz), (tx, ty, tz))

    def _slip(self, numbers: list[float]) -> None:
        plant, joint = self._controller.plant, numbers[0]
        if joint not in range(1, len(plant.q) + 1):
            raise BenchError(f"slip: found joint {joint:g}, expected 1 to {len(plant.q)}")
        _check_size("slip", numbers[1:], math.pi, "rad")
        plant.slip(int(joint) - 1, numbers[1])

    # -- for scoring ------------------------------------------------------------------------------

    def _truth(self, _: list[float]) -> str:
        plant = self._controller.plant
        s, load = plant.settings, plant.load
        rigid = place(plant.arm.flange(plant.q), plant.tool)
        return json.dumps(
            {
                "compliance": {"axial": s.axial, "radial": s.radial},
                "payload": {"mass": load.mass, "cog": load.cog},
                "wrench": [*load.force, *load.torque],
                "tcp": s.tcp,
                "joint_error": plant.scatter,
                "joint_scatter": s.joint_scatter,
                "repeatability": tcp_scatter(self._controller),
                "placements": plant.placements,
                "largest_servo_step": self._controller.largest_servo_step,
                "true_tcp": pose_of(plant.true_tcp()),
                "rigid_tcp": pose_of(rigid),
                "sensor_bias": s.sensor_bias,
                "servo_lag": s.servo_lag,
                "tracker_noise": s.tracker_noise,
                "seed": s.seed,
            }
        )

    def _help(self, _: list[float]) -> str:
        return "; ".join(f"{name}: {text}" for name, (_n, _a, text) in self._commands.items())


def tcp_scatter(controller: BenchSubject) -> float:
    """Return the rms length (m) of the TCP's placement error at the present joints."""
    plant = controller.plant
    step = 1e-6

    def tip(q: tuple[float, ...]) -> Frame:
        return place(plant.arm.flange(q), plant.tool)

    here = tip(plant.q).origin
    total = 0.0
    for i, sigma in enumerate(plant.settings.joint_scatter):
        q = (*plant.q[:i], plant.q[i] + step, *plant.q[i + 1 :])
        total += (math.dist(tip(q).origin, here) / step * sigma) ** 2
    return math.sqrt(total)


def _check_size(name: str, values: Sequence[float], most: float, unit: str) -> None:
    """Refuse numbers beyond which the plant's equilibrium has no meaning, or no numbers."""
    largest = max(values, key=abs)
    if abs(largest) > most:
        raise BenchError(f"{name}: found {largest:g} {unit}, expected at most {most:g}")


def _numbers(name: str, arguments: list[str], count: int) -> list[float]:
    """Return exactly `count` finite numbers."""
    if len(arguments) != count:
        raise BenchError(f"{name}: found {len(arguments)} numbers, expected {count}")
    try:
        numbers = [float(word) for word in arguments]
    except ValueError:
        raise BenchError(f"{name}: found {' '.join(arguments)!r}, expected numbers") from None
    if not all(map(math.isfinite, numbers)):
        raise BenchError(f"{name}: found {' '.join(arguments)!r}, expected finite numbers")
    return numbers
