"""UR over RTDE: what stands for the library's three interfaces, and for the robot's program."""

from __future__ import annotations

import contextlib
import math
import random
import sys
import types
from collections.abc import Iterator
from statistics import median
from typing import Any

import numpy as np

from benchmarks.simulation.links import SimulatedLink
from gapbridge.bridge.loop.link_monitor import CLOCK_STEP
from gapbridge.drivers.controller_facts import ControllerFacts
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.simulated.plant.kinematics import (
    gap,
    jacobian,
    offset_frame,
    solve,
    tcp_in_base,
)
from gapbridge.drivers.simulated.server.arm_controller import ArmController
from gapbridge.drivers.simulated.ur import modes
from gapbridge.drivers.simulated.ur.programs.offset_program import (
    NOTHING,
    OffsetRegisters,
    approach,
)
from gapbridge.drivers.ur_rtde import command, registers
from gapbridge.drivers.ur_rtde import driver as ur_driver
from gapbridge.drivers.ur_rtde.driver import UrRtdeDriver
from gapbridge.drivers.ur_rtde.enquiry import ASK_EVERY, TRIES

UPLOAD = 0.1  # s that uploading a script takes
DEAD_AFTER = 0.3  # s of a broken connection until the library says so
GETTERS = {
    "getActualQ": "actual_q", "getActualQd": "actual_qd", "getTargetQ": "target_q",
    "getActualTCPForce": "actual_TCP_force", "getFtRawWrench": "ft_raw_wrench",
    "getJointTemperatures": "joint_temperatures", "getActualCurrent": "actual_current",
    "getPayloadCog": "payload_cog", "getRobotMode": "robot_mode", "getSafetyMode": "safety_mode",
    "getRuntimeState": "runtime_state", "getSafetyStatusBits": "safety_status_bits",
    "getSpeedScaling": "speed_scaling", "getPayload": "payload",
    "getActualTCPPose": "actual_TCP_pose", "getTimestamp": "timestamp",
}  # fmt: skip
Packet = dict[str, Any]
STOPPED = 1 << 10
MODES = (
    *((mode, modes.SAFETY_NORMAL, 1) for mode in (-1, 0, 1, 2, 3, 4, 5, 6)),
    (modes.RUNNING, 4, 1 << 3 | STOPPED), (modes.RUNNING, 5, 1 << 4 | STOPPED),
    (modes.POWER_OFF, 6, 1 << 5 | 1 << 7 | STOPPED), (modes.RUNNING, 8, 1 << 8 | STOPPED),
    (modes.RUNNING, 9, 1 << 9 | STOPPED),
)  # fmt: skip
"""Robot mode, safety mode and bits in which the arm does not move; stops have their own faults."""


class _Driver(UrRtdeDriver):
    """The product's, without the sockets that only ask."""

    link: UrLink

    def facts(self, state: Any) -> ControllerFacts:
        """Return what the state says: the primary interface is not simulated."""
        return ControllerFacts(n=6, payload=state.payload, q=state.actual_q)


class UrLink(SimulatedLink):
    """One UR controller. ``mode`` as in the cell: servoj or offset."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        self.offsets = self.setting.name == "ur_offset"
        self.latest: Packet | None = None  # that has reached the client
        self._arrived = 0.0  # s: when it did
        self.script = False  # the control script runs
        self.program = self.offsets  # the robot's own program runs
        self.speed = 1.0
        self.refuses_servo = False
        self.is_remote = True  # the controller takes scripts from clients
        self.mode: tuple[int, int, int] | None = None  # in which it does not move; None: it can
        self._kicked = 0.0
        self._watchdog = 0.25  # s
        self._since_cut = math.inf
        self._inputs: dict[str, Any] = {}
        self._registers: OffsetRegisters | None = None
        self._applied = NOTHING
        self._solved: Any = None
        self._solves_at: Any = None  # joints, rad, and tool that ``_inverse`` is of
        self._inverse: Any = None  # of the Jacobian
        self._own_tcp: Any = None  # without an offset, in base
        self._kept_q: Any = None

    def driver(self) -> Driver:
        """See SimulatedLink.driver."""
        setting = self.setting
        found = _Driver(setting.cell.link, setting.cell.model, self.clock)
        found.link = self
        return found

    # -- the library ------------------------------------------------------------------------------

    def modules(self) -> dict[str, types.ModuleType]:
        """Return the library's modules as its driver imports them."""
        return {
            "rtde_receive": _module(RTDEReceiveInterface=lambda *_: _Receive(self)),
            "rtde_control": _module(RTDEControlInterface=_control_class(self)),
            "rtde_io": _module(RTDEIOInterface=lambda *_: _Inputs(self)),
        }

    def connect(self) -> None:
        """Open a connection. Raises RuntimeError, as the library does."""
        self.clock.sleep(0.03)
        if not self.reachable:
            raise RuntimeError("Connection refused")
        self.reconnected()
        self._since_cut = math.inf
        self.latest = None
        for _ in range(200):
            self.clock.sleep(0.005)
            if self.latest is not None:
                return
        raise RuntimeError("no answer")

    def ask(self) -> float:
        """Return how long a question and its answer take now, s."""
        way = self.round_trip(self.world.random)
        self.clock.sleep(min(way, 1.0))
        if self.up.is_cut or way > 1.0:
            from gapbridge.core.errors import WriteError

            raise WriteError("found no answer on RTDE's port 30004")
        return way

    def round_trip(self, draw: Any) -> float:
        """Return how long a question asked now and its answer are under way, s."""
        way = max(self.down.held_until - self.world.now, 0.0)
        for wire in (self.up, self.down):
            way += wire.delay_now + draw.uniform(0.0, wire.jitter)
        return way

    @property
    def connected(self) -> bool:
        """Return what the library says: it takes a while until it knows."""
        return self.world.now < self._since_cut + DEAD_AFTER

    def disconnect(self) -> None:
        """See SimulatedLink.disconnect."""
        super().disconnect()
        self._since_cut = self.world.now

    def forget_client(self) -> None:
        """See SimulatedLink.forget_client."""
        super().forget_client()
        self.script = False
        if self.offsets:
            self.program, self._registers, self._applied = False, None, NOTHING

    def heal(self) -> None:
        """See SimulatedLink.heal."""
        super().heal()
        self.speed, self.refuses_servo, self.is_remote = 1.0, False, True
        self.controller.declared.set_tcp(self.setting.arm[1].tcp)
        if self.offsets and not self.program:
            self.program, self._registers = True, None

    # -- the controller ---------------------------------------------------------------------------

    def cycle(self) -> None:
        """Run the control script's watchdog, or the robot's own program."""
        controller = self.controller
        if self.script and (
            self.world.now - self._kicked > self._watchdog or not controller.can_move
        ):
            self.script = False
            controller.let_go()
        if self.offsets:
            self._run_program()

    def _run_program(self) -> None:
        controller, memory = self.controller, self._inputs
        if self.is_paused:
            return
        if not self.program or not controller.can_move:
            self.program = self.program and controller.can_move
            self._registers, self._applied = None, NOTHING
            memory["output_int_register_13"] = 0
            controller.offset_by((0.0,) * 6)
            return
        if self._registers is None:
            for name in [
                *(f"input_double_register_{i}" for i in registers.OFFSET_DOUBLES),
                *(f"input_int_register_{i}" for i in range(18, 23)), "output_int_register_12",
            ]:  # fmt: skip
                memory.setdefault(name, 0)
            memory["output_int_register_12"] = 0
            self._registers = OffsetRegisters(memory)
        memory["output_int_register_13"] = self._registers.cycle(self.period)
        steps = tuple(step * self.period / 0.002 for step in self._registers.steps)
        self._applied = approach(self._applied, self._registers.wanted, (steps[0], steps[1]))
        self._apply()

    def _apply(self) -> None:
        controller = self.controller
        key = (controller.own_q, self._applied)
        if key == self._solved:
            return
        self._solved = key
        if self._applied == NOTHING:
            controller.offset_by((0.0,) * 6)
            return
        arm, tool = controller.plant.arm, controller.declared.tool
        near = [a + b for a, b in zip(controller.own_q, controller.joint_offset, strict=True)]
        if self._solves_at != (controller.own_q, tool):
            self._solves_at = controller.own_q, tool
            self._own_tcp = tcp_in_base(arm, controller.own_q, tool)
            self._inverse = np.linalg.pinv(jacobian(arm, near, tool))
        wanted = offset_frame(self._own_tcp, self._applied)
        found: Any = None
        for _ in range(6):  # offsets are small: one Jacobian does for all
            step = gap(tcp_in_base(arm, near, tool), wanted)
            if max(map(abs, step)) < 1e-11:
                found = near
                break
            near = [a + b for a, b in zip(near, (self._inverse @ step).tolist(), strict=True)]
        else:
            found = solve(arm, wanted, near, tool, steps=20)
        if found is not None:
            controller.offset_by([a - b for a, b in zip(found, controller.own_q, strict=True)])

    def publish(self) -> None:
        """Send one packet of RTDE."""
        controller = self.controller
        mode = modes.RUNNING
        safety = modes.SAFETY_NORMAL
        if controller.protective:
            safety = modes.SAFETY_PROTECTIVE
        if controller.emergency:
            safety, mode = modes.SAFETY_ROBOT_EMERGENCY, modes.POWER_OFF
        bits = modes.SAFETY_BITS[safety]
        if self.mode is not None:
            mode, safety, bits = self.mode
        playing = modes.STOPPED
        if self.program if self.offsets else self.script:
            playing = modes.PAUSED if self.is_paused else modes.PLAYING
        q = controller.q
        if self.freezes_values:
            q = self._kept_q or q
        self._kept_q = q
        packet: Packet = {
            "timestamp": controller.clock, "actual_q": list(q), "actual_qd": list(controller.qd),
            "target_q": list(controller.target_q), "actual_TCP_force": list(controller.tcp_force),
            "ft_raw_wrench": list(controller.raw_wrench),
            "joint_temperatures": list(controller.temperatures), "actual_current": [0.8] * 6,
            "payload_cog": list(controller.declared.payload_cog),
            "payload": controller.declared.payload_mass, "robot_mode": mode,
            "safety_mode": safety, "safety_status_bits": bits, "runtime_state": playing,
            "speed_scaling": self.speed,
            "actual_TCP_pose": list(controller.memory["actual_TCP_pose"]),
            "ints": {12: self._inputs.get("output_int_register_12", 0),
                     13: self._inputs.get("output_int_register_13", 0)},
            "doubles": dict(zip(registers.APPLIED, self._applied, strict=True)),
            "sampled": self.world.now,
        }  # fmt: skip
        self.down.send(packet)

    def _on_down(self, packet: Packet) -> None:
        if self.latest is not None and packet["timestamp"] == self.latest["timestamp"]:
            self.latest = packet
            return
        self._note_hidden_leap(packet)
        self.latest, self._arrived = packet, self.world.now
        self._sampled[packet["timestamp"]] = packet["sampled"]
        safe = packet["safety_mode"] in (1, 2) and packet["robot_mode"] == 7
        q = packet["actual_q"]
        if all(map(math.isfinite, q)):
            bare = self.offsets and not any(packet["doubles"].values())
            self.see((packet["timestamp"], q, packet["target_q"], safe), bare)

    def _note_hidden_leap(self, packet: Packet) -> None:
        """Note where the clock is set forward and the next packet comes later by as much.

        Timestamps and arrivals are then those of a clock that nobody touched. The echo of
        offsets shows it nevertheless, except in the first setpoint after a pause.
        """
        before = self.latest
        if before is None:
            return
        gap = packet["timestamp"] - before["timestamp"]
        leap = gap - (packet["sampled"] - before["sampled"])
        if leap > CLOCK_STEP / 2 and gap - (self.world.now - self._arrived) <= CLOCK_STEP:
            self.hidden_leap = max(self.hidden_leap, leap)

    def _on_up(self, message: tuple[str, Any]) -> None:
        kind, value = message
        controller: ArmController = self.controller
        if self.world.now < self.rebooting_until:
            return
        if kind == "script":
            if not self.is_remote:
                return
            self.script, self._kicked = controller.can_move, self.world.now
        elif kind == "watchdog":
            self._watchdog, self._kicked = 1.0 / value, self.world.now
        elif kind == "kick":
            self._kicked = self.world.now
        elif kind == "stop":
            self.script = False
            controller.let_go()
        elif kind == "servo" and self.script and not self.is_paused:
            self._kicked = self.world.now
            controller.command(value)
        elif kind == "register":
            self._inputs[value[0]] = value[1]

    def enter_mode(self, draw: random.Random) -> str:
        """See SimulatedLink.enter_mode."""
        self.mode = draw.choice(MODES)
        self.controller.protective_stop()
        return "robot mode {}, safety mode {}, bits {:#b}".format(*self.mode)

    def leave_mode(self) -> None:
        """See SimulatedLink.leave_mode."""
        if self.mode is not None:
            self.mode = None
            self.controller.unlock()

    def foreign(self, seconds: float) -> None:
        """Have another script be uploaded: it ends the one that runs."""
        self.script = False
        self.controller.let_go()
        if self.offsets:
            self.program = False


class _Receive:
    """RTDEReceiveInterface: the last packet that has come, for ever."""

    def __init__(self, link: UrLink) -> None:
        link.connect()
        self._link = link
        for getter, name in GETTERS.items():
            setattr(self, getter, self._getter(name))

    def _getter(self, name: str) -> Any:
        link = self._link
        return lambda: link.latest[name] if link.latest is not None else 0.0

    def getOutputIntRegister(self, register: int) -> int:
        return int(self._link.latest["ints"][register]) if self._link.latest else 0

    def getOutputDoubleRegister(self, register: int) -> float:
        return float(self._link.latest["doubles"][register]) if self._link.latest else 0.0

    def isConnected(self) -> bool:
        return self._link.connected

    def disconnect(self) -> None: ...


class _RoundTrip:
    """RoundTrip of the driver: questions on a connection of its own."""

    def __init__(self, link: UrLink) -> None:
        self._link = link
        self._draw = random.Random(0)  # not the world's: a seed is the run that it was before
        self.close()

    def measure(self) -> float:
        """Return the median of some. Raises WriteError."""
        self.close()
        found = median(self._link.ask() for _ in range(TRIES))
        self._is_open = True
        return found

    def poll(self) -> float | None:
        """Return the last one, once, where its answer has come, s, and ask again in time."""
        now = self._link.world.now
        if not self._is_open or self._link.up.is_cut:
            return None
        if self._way == math.inf and now - self._asked >= ASK_EVERY:
            self._asked, self._way = now, self._link.round_trip(self._draw)
        elif self._asked + self._way <= now:
            self._way = math.inf
            return now - self._asked
        return None

    def close(self) -> None:
        """Drop the connection."""
        self._is_open, self._asked, self._way = False, -1e9, math.inf


def _control_class(link: UrLink) -> type:
    class RTDEControlInterface:
        """The library's writing half, through its control script."""

        FLAG_UPLOAD_SCRIPT = 1

        def __init__(self, *_: Any) -> None:
            link.clock.sleep(UPLOAD)
            if not link.reachable or link.up.is_cut:
                raise RuntimeError("Connection refused")
            self.reuploadScript()
            link.clock.sleep(UPLOAD)
            if not link.script:
                raise RuntimeError("RTDE control program is not running")

        def reuploadScript(self) -> bool:
            link.wrote("other", (), "script")
            link.up.send(("script", None))
            return True

        def setWatchdog(self, rate: float) -> bool:
            link.wrote("other", (), "watchdog")
            link.up.send(("watchdog", rate))
            return True

        def kickWatchdog(self) -> bool:
            link.wrote("other", (), "kick")
            link.up.send(("kick", None))
            link.clock.sleep(min(link.up.delay_now + link.down.delay_now, 0.2))
            return True

        def isConnected(self) -> bool:
            return link.connected

        def isProgramRunning(self) -> bool:
            return bool(link.latest and link.latest["runtime_state"] == modes.PLAYING)

        def servoJ(self, q: list[float], *_: float) -> bool:
            link.wrote("joints", tuple(q), "servoJ")
            link.up.send(("servo", tuple(q)))
            return not link.refuses_servo

        def servoStop(self, _: float) -> bool:
            link.wrote("other", (), "servoStop")
            return True

        def stopScript(self) -> None:
            link.wrote("other", (), "stopScript")
            link.up.send(("stop", None))

    return RTDEControlInterface


class _Inputs:
    """RTDEIOInterface: a packet for each register."""

    def __init__(self, link: UrLink) -> None:
        link.clock.sleep(0.05)
        if not link.reachable or link.up.is_cut:
            raise RuntimeError("Connection refused")
        self._link, self._sent = link, dict[tuple[str, int], float]()

    def setInputDoubleRegister(self, register: int, value: float) -> bool:
        return self._set("double", register, value)

    def setInputIntRegister(self, register: int, value: int) -> bool:
        if register == registers.SEQUENCE:
            turn = self._sent.get(("int", registers.OFFSET_RZ), 0) * registers.UNIT
            values = [self._sent.get(("double", i), 0.0) for i in registers.OFFSET_DOUBLES]
            self._link.wrote("offset", (*values, turn), "registers")
        return self._set("int", register, value)

    def _set(self, kind: str, register: int, value: float) -> bool:
        self._link.wrote("other", (), "register")
        self._sent[kind, register] = value
        self._link.up.send(("register", (f"input_{kind}_register_{register}", value)))
        return True


def _module(**names: Any) -> types.ModuleType:
    found = types.ModuleType("simulated")
    found.__dict__.update(names)
    return found


@contextlib.contextmanager
def library(link: SimulatedLink) -> Iterator[None]:
    """Have the library and the driver's own sockets be this link's while the block lasts."""
    if not isinstance(link, UrLink):
        yield
        return
    modules = link.modules()
    before = {name: sys.modules.get(name) for name in modules}
    at_once, round_trip = command.send_at_once, ur_driver.RoundTrip
    sys.modules.update(modules)
    command.send_at_once = lambda: 0
    ur_driver.RoundTrip = lambda *_: _RoundTrip(link)  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        command.send_at_once, ur_driver.RoundTrip = at_once, round_trip  # type: ignore[misc]
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module


def spoiled(packet: Packet, draw: Any) -> Packet:
    """Return a packet with one of its numbers wrong."""
    found = {**packet, "actual_q": list(packet["actual_q"]), "actual_qd": [*packet["actual_qd"]]}
    joint = draw.randrange(6)
    wrong = draw.choice([math.nan, math.inf, -math.inf, 1e300, found["actual_q"][joint] + 0.3])
    found[draw.choice(["actual_q", "actual_q", "actual_qd"])][joint] = wrong
    return found


def spoiled_anywhere(packet: Packet, draw: Any) -> Packet:
    """Return a packet with one number wrong, of any field."""
    name = draw.choice([key for key in packet if key != "sampled"])
    value = packet[name]
    if isinstance(value, dict):
        key = draw.choice(list(value))
        return {**packet, name: {**value, key: _wrong(value[key], draw)}}
    if isinstance(value, list):
        at = draw.randrange(len(value))
        return {**packet, name: [*value[:at], _wrong(value[at], draw), *value[at + 1 :]]}
    return {**packet, name: _wrong(value, draw)}


def _wrong(value: float, draw: Any) -> float:
    if isinstance(value, int):
        return value ^ 1 << draw.randrange(12)
    wrong: float = draw.choice([math.nan, math.inf, -math.inf, 1e300, -1.0, 0.0, value + 0.3])
    return wrong


def spoiled_order(message: tuple[str, Any], draw: Any) -> tuple[str, Any]:
    """Return a message to the controller with a register's value wrong."""
    kind, value = message
    if kind != "register":
        return message
    register, number = value
    if isinstance(number, int):
        return kind, (register, number ^ 1 << draw.randrange(31))
    return kind, (register, draw.choice([0.0, -number, number + 1e-3]))
