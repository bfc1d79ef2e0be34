"""UR with a force-torque sensor: the product's driver of it, on a bus in memory of its own."""

from __future__ import annotations

import struct
import threading
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple, cast

import can as python_can

from benchmarks.faults.wire.seen import Numbers
from benchmarks.simulation.ur import UrLink
from benchmarks.simulation.wires import Wire
from benchmarks.simulation.world import Process, SimulatedClock, World
from gapbridge.bridge.ipc.loop_state import State
from gapbridge.core.errors import LinkError
from gapbridge.drivers.driver import Driver
from gapbridge.drivers.ft_sensor.joined import DriverWithSensor, SensorReader
from gapbridge.drivers.ft_sensor.robotous_rft import START, STOP, PairDecoder, RobotousRft

POLL = 0.002  # s between two looks at an event
SLACK = 0.02  # s: cycles of arm and sensor
LAYOUT = struct.Struct(">B6hB2x")


class SensorFrame(NamedTuple):
    """A frame of the sensor as python-can gives it, and when it was measured, s."""

    arbitration_id: int
    data: bytes
    sampled: float
    timestamp: float = 0.0
    is_error_frame = is_remote_frame = is_extended_id = False


class _Clock(SimulatedClock):
    """The world's, where who waits for an event is woken by it soon."""

    def wait(self, event: threading.Event, seconds: float) -> bool:
        process, until = self.world.current, self.world.now + seconds
        assert process is not None
        while not event.is_set() and self.world.now < until:
            process.sleep(min(POLL, until - self.world.now))
        return event.is_set()


class _OfProcess(Process):
    """What runs in another process, and no longer than it."""

    def __init__(self, world: World, main: Callable[[], None], owner: Process) -> None:
        self._owner = owner
        super().__init__(world, "ft-sensor", main)

    def _resume(self, ticket: int) -> None:
        if self._owner.over or self._owner.dead:
            self.kill()
        super()._resume(ticket)


class _Thread:
    """A thread of a loop's process: it ends and stands still with it."""

    def __init__(self, world: World, main: Callable[[], None]) -> None:
        assert world.current is not None
        self.owner = world.current
        self._process = _OfProcess(world, main, self.owner)

    def join(self, timeout: float) -> None:
        self._process.kill()


class _Reader(SensorReader):
    """The product's, whose thread takes its turn in the world."""

    link: SensorLink

    def _begin_thread(self) -> threading.Thread:
        thread = _Thread(self.link.world, self._run)
        self.link.reading_for = thread.owner
        return cast(threading.Thread, thread)


class _Sensor(RobotousRft):
    """The product's, on the link's bus."""

    link: SensorLink

    def connect(self) -> None:
        link = self.link
        if link.world.now < link.sensor_refuses_until:
            raise LinkError(f"{self.name}: cannot be opened: refused")
        self._bus = link.bus = _Bus(link)
        self._decoder = PairDecoder(self.settings.reply_ids, 0.5 / self.settings.rate)
        self._command(START)


class _Bus:
    """The client's end, as python-can gives it."""

    def __init__(self, link: SensorLink) -> None:
        self._link, self.lost = link, False
        self.frames: deque[SensorFrame] = deque()
        self.waiting: Process | None = None

    def send(self, frame: Any, timeout: float) -> None:
        if self.lost:
            raise python_can.CanOperationError("No such device")
        self._link.command_sensor(frame.data[0])

    def recv(self, timeout: float) -> SensorFrame | None:
        world, owner = self._link.world, self._link.reading_for
        process, until = world.current, world.now + timeout
        assert process is not None
        while not self.frames or (owner is not None and world.now < owner._frozen_until):
            if owner is not None:
                owner.check()
            if self.lost:
                raise python_can.CanOperationError("No such device")
            left = until - world.now
            if left <= 0.0:
                return None
            self.waiting = process
            process.sleep(left)
        return self.frames.popleft()

    def take(self, frame: SensorFrame) -> None:
        """Take a frame of the bus, from the world."""
        self.frames.append(frame._replace(timestamp=self._link.world.now))
        self.wake()

    def wake(self) -> None:
        """Have who waits look again."""
        waiting, self.waiting = self.waiting, None
        if waiting is not None:
            waiting.wake()

    def shutdown(self) -> None: ...


class SensorLink(UrLink):
    """One UR controller, moved by servoJ, and a Robotous RFT."""

    def __init__(self, *given: Any) -> None:
        super().__init__(*given)
        sensor: Any = self.setting.cell.ft_sensor
        # degraded, the loop goes on without forces; by the seed
        when_lost = self.world.random.choice(("stop", "degrade"))
        self.sensor_settings = sensor.model_copy(update={"when_lost": when_lost})
        self.sensor_wire: Wire[SensorFrame] = Wire(self.world, self._deliver)
        self.bus: _Bus | None = None
        self.reading_for: Process | None = None
        self.sensor_refuses_until = self.sensor_silent_until = 0.0
        self.overloaded = False
        self._streams = False
        self._half: SensorFrame | None = None
        self.sensed = self.world.now  # s: when the newest whole sample was measured
        self.arrived = self.world.now  # s: when it was here
        self.world.every(lambda: 1.0 / sensor.rate, self._measure)

    def driver(self) -> Driver:
        """See SimulatedLink.driver."""
        found = DriverWithSensor(super().driver(), self.sensor_settings, self.setting.cell.model)
        reader = found._reader
        reader.__class__ = _Reader
        reader._sensor.__class__ = _Sensor
        reader._clock = _Clock(self.world)
        cast(Any, reader).link = cast(Any, reader._sensor).link = self
        return found

    # -- the sensor -------------------------------------------------------------------------------

    def command_sensor(self, code: int) -> None:
        """Start or stop its stream."""
        if code in (START, STOP):
            self._streams = code == START

    def _measure(self) -> None:
        now, settings = self.world.now, self.sensor_settings
        if not self._streams or now < self.sensor_silent_until:
            return
        scale = 3 * (settings.force_counts,) + 3 * (settings.torque_counts,)
        wrench = zip(self.controller.raw_wrench, scale, strict=True)
        counts = [max(-32768, min(32767, round(v * k))) for v, k in wrench]
        sample = LAYOUT.pack(START, *counts, int(self.overloaded))
        for identifier, part in zip(settings.reply_ids, (sample[:8], sample[8:]), strict=True):
            self.sensor_wire.send(SensorFrame(identifier, part, now))

    def _deliver(self, frame: SensorFrame) -> None:
        bus = self.bus
        if bus is None or bus.lost:
            return
        first, second = self.sensor_settings.reply_ids
        if frame.arbitration_id == first:
            self._half = frame
        elif self._half is not None and frame.arbitration_id == second:
            whole = self._half.sampled == frame.sampled and not self.overloaded
            self.sensed = frame.sampled if whole else self.sensed
            if not self.overloaded:
                self.arrived = self.world.now
        bus.take(frame)

    def lose_bus(self, seconds: float) -> None:
        """Have the sensor's adapter be gone for a while."""
        self.sensor_refuses_until = self.world.now + seconds
        if self.bus is not None:
            self.bus.lost = True
            self.bus.wake()

    def heal(self) -> None:
        """See SimulatedLink.heal."""
        super().heal()
        self.sensor_wire.heal()
        self.sensor_refuses_until = self.sensor_silent_until = 0.0
        self.overloaded = False

    def wrote(self, kind: Any, values: Numbers, where: str) -> None:
        """See SimulatedLink.wrote; no setpoint leaves without the sensor where it must not."""
        if kind == "joints" and State(self.supervisor_state()).writes and self.must_not_write:
            kind, where = "forbidden", f"{where} while the sensor is lost"
        super().wrote(kind, values, where)

    @property
    def must_not_write(self) -> bool:
        """Return whether the sensor has been lost for longer than a state may be old."""
        settings = self.sensor_settings
        most = settings.max_age + self.setting.bounds.fresh + SLACK
        return settings.when_lost == "stop" and self.world.now - self.sensed > most


# -- what goes wrong with the sensor ------------------------------------------------------------


def _lost(link: SensorLink, draw: Any) -> str:
    seconds = draw.choice((0.03, 0.08, 0.3, 2.0, 60.0))
    link.sensor_silent_until = link.world.now + seconds
    return f"{link.sensor_settings.when_lost}, {seconds:g} s"


def _bus_lost(link: SensorLink, draw: Any) -> str:
    seconds = draw.choice((0.0, 0.2, 2.0))
    link.lose_bus(seconds)
    return f"{link.sensor_settings.when_lost}, {seconds:g} s"


def _overloaded(link: SensorLink, draw: Any) -> str:
    seconds = draw.choice((0.02, 0.2, 2.0))
    link.overloaded = True
    link.world.after(seconds, lambda: setattr(link, "overloaded", False))
    return f"{link.sensor_settings.when_lost}, {seconds:g} s"


def _frames(link: SensorLink, draw: Any) -> str:
    """Have frames of the sensor be lost, doubled, cut short, or come in a burst."""
    wire, what = link.sensor_wire, draw.choice(("lost", "doubled", "cut short", "held back"))
    if what == "lost":
        wire.lost = draw.choice((0.05, 0.5))
    elif what == "doubled":
        wire.doubled = 0.3
    elif what == "cut short":
        wire.change = lambda frame: frame._replace(data=frame.data[: draw.randrange(8)])
        wire.changed = draw.choice((1, 5, 30))
    else:
        wire.hold(draw.choice((0.04, 0.3, 1.0)))
    return what


FAMILIES: tuple[tuple[str, Callable[[SensorLink, Any], str]], ...] = (
    ("FT sensor lost", _lost),
    ("FT sensor's bus lost", _bus_lost),
    ("FT sensor overloaded", _overloaded),
    ("FT sensor's frames", _frames),
)
