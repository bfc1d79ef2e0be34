"""What the writers hand to the library, by the clock and without a robot.

test_ur_servo.py and test_ur_offset.py show the same over the real protocol, and take longer.
"""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from clock_by_hand import ByHand

from gapbridge.core.errors import WriteError
from gapbridge.core.state import RobotState, Setpoint
from gapbridge.drivers.robot_modes import PAUSED, PLAYING
from gapbridge.drivers.ur_rtde import command, registers
from gapbridge.drivers.ur_rtde.command import (
    CONTROL,
    KICK,
    AllowedControl,
    AllowedInputs,
    OffsetWriter,
    ServoWriter,
)
from gapbridge.drivers.ur_rtde.settings import UrRtdeSettings

Q = np.array([0.0, -1.5, 1.8, -1.87, -1.57, 0.0])
SETTINGS = UrRtdeSettings(host="192.0.2.7", rate=500.0)
CYCLE = 0.002
STOPPED = 1  # runtime_state
SPEED = 0.1  # rad/s
RATES = 0.04, 0.08  # m/s, rad/s: of the cell


class Library:
    """Notes what reaches it; every call succeeds but those of ``refused``."""

    def __init__(self) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.refused: set[str] = set()
        self.broken = False  # the connection has ended: every call raises

    def __getattr__(self, name: str) -> Callable[..., bool]:
        def call(*given: Any) -> bool:
            self.calls.append((name, *given))
            if self.broken:
                raise RuntimeError("write: Broken pipe [system:32]\nat boost/asio")
            return name not in self.refused

        return call

    def of(self, name: str) -> list[tuple[Any, ...]]:
        return [call[1:] for call in self.calls if call[0] == name]


def state(q: np.ndarray = Q, **fields: Any) -> RobotState:
    return RobotState(0.0, 0.0, q, np.zeros(6), q, np.zeros(6), **fields)


def setpoint(q: np.ndarray = Q, offset: Any = (0.0,) * 6) -> Setpoint:
    return Setpoint(q, Q, np.array(offset))


class Servo(ServoWriter):
    """The writer of joint setpoints on a library that only notes."""

    def __init__(self) -> None:
        self.library, self.clock = Library(), ByHand()
        super().__init__(SETTINGS, self.clock)

    def _open(self) -> Any:
        self.library.calls.append(("opened",))
        return AllowedControl("192.0.2.7", self.library)


class Offset(OffsetWriter):
    """The writer of offsets, and a robot's program that echoes ``lag`` looks later, or never."""

    def __init__(self) -> None:
        self.library, self.clock = Library(), ByHand()
        super().__init__(SETTINGS, lambda: RATES, self.clock)
        self.applied = np.zeros(6)
        self.echoes = True
        self.note_answer(17, registers.Program.RUNNING, self.applied)

    def _open(self) -> AllowedInputs:
        return AllowedInputs("192.0.2.7", self.library)

    def look(self) -> None:
        self.clock.sleep(CYCLE)
        sent = [r[1] for r in self.library.of("setInputIntRegister") if r[0] == registers.SEQUENCE]
        echo = sent[-1] if sent and self.echoes else self._echo
        self.note_answer(echo, registers.Program.RUNNING, self.applied)


@pytest.fixture
def servo() -> Servo:
    writer = Servo()
    writer.arm(state(runtime_state=STOPPED), lambda: None)
    return writer


@pytest.fixture
def offset() -> Offset:
    writer = Offset()
    writer.arm(state(runtime_state=PLAYING), writer.look)
    writer.library.calls.clear()
    return writer


def turned(angle: float) -> np.ndarray:
    """Return joints of which the first is turned."""
    q = Q.copy()
    q[0] += angle
    return q


def stream(writer: Servo, seconds: float, behind: Callable[[float], float]) -> float:
    """Move the first joint until an error comes; returns after how many seconds one came.

    ``behind``: how far the controller's target is behind a setpoint sent so many seconds after the
    first, rad.
    """
    for k in range(round(seconds / CYCLE)):
        at = k * CYCLE
        try:
            writer.write(setpoint(turned(SPEED * at)), state(turned(SPEED * at - behind(at))))
        except WriteError as error:
            if "setpoints do not arrive: joint 1" not in str(error):
                raise
            return at
        writer.clock.sleep(CYCLE)
    return seconds


def test_a_target_that_never_follows_ends_the_stream(servo: Servo) -> None:
    begun = 0.02 / SPEED  # s: until the setpoints are farther from it than it may be
    after = stream(servo, 3.0, lambda at: SPEED * at)
    assert SETTINGS.following <= after < SETTINGS.following + begun + 0.05


def test_a_target_that_lags_is_no_fault(servo: Servo) -> None:
    lag = 0.9 * SETTINGS.following
    assert stream(servo, 3.0, lambda at: SPEED * min(at, lag)) == 3.0


def test_servoj_gets_the_setpoint_the_period_lookahead_and_gain(servo: Servo) -> None:
    servo.write(setpoint(Q + 0.01), state())
    assert servo.library.of("servoJ") == [((Q + 0.01).tolist(), 0.0, 0.0, CYCLE, 0.1, 300.0)]


def test_a_refused_servoj_is_a_failed_write(servo: Servo) -> None:
    servo.library.refused = {"servoJ"}
    with pytest.raises(WriteError, match="refused servoJ"):
        servo.write(setpoint(), state())


@pytest.mark.parametrize("ended", ["isConnected", "isProgramRunning"])
def test_nothing_is_sent_to_a_script_that_has_ended(servo: Servo, ended: str) -> None:
    servo.library.refused = {ended}
    with pytest.raises(WriteError, match="has ended"):
        servo.write(setpoint(), state())
    assert not servo.library.of("servoJ")


@pytest.mark.parametrize("kept", [True, False])
def test_the_robots_watchdog_is_fed_before_it_expires(servo: Servo, kept: bool) -> None:
    assert servo.library.of("setWatchdog") == [(SETTINGS.watchdog,)]
    kicks = []
    for _ in range(500):
        before = len(servo.library.of("kickWatchdog"))
        if kept:  # by the loop, before each setpoint
            servo.keep_alive()
        servo.write(setpoint(), state())
        if len(servo.library.of("kickWatchdog")) > before:
            kicks.append(servo.clock.now)
            names = [call[0] for call in servo.library.calls]
            assert names[::-1].index("servoJ") < names[::-1].index("kickWatchdog")  # writes last
        servo.clock.sleep(CYCLE)
    assert np.diff(kicks).max() < (KICK + 2 * CYCLE if kept else 0.5 / SETTINGS.watchdog)


def test_a_connection_that_the_library_replaces_ends_the_stream(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its new script has no watchdog: who is killed then leaves it running."""
    library, clock = Library(), ByHand()
    opened: list[socket.socket] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def connect(*_: Any) -> Library:
            opened.append(socket.create_connection(server.getsockname()))
            return library

        port = server.getsockname()[1]
        monkeypatch.setattr(command, "RTDE", port)
        flags = {"FLAG_UPLOAD_SCRIPT": 1, "__call__": staticmethod(connect)}
        interface = type("RTDEControlInterface", (), flags)()
        known = SimpleNamespace(RTDEControlInterface=interface)
        monkeypatch.setitem(sys.modules, "rtde_control", known)
        other = socket.create_connection(server.getsockname())  # of the round trip
        writer = ServoWriter(SETTINGS, clock)
        writer.arm(state(runtime_state=STOPPED), lambda: None)
        other.close()
        for _ in range(50):
            writer.keep_alive()
            writer.write(setpoint(), state())
            clock.sleep(CYCLE)
        connect()
        opened[0].close()
        clock.sleep(KICK + CYCLE)
        with pytest.raises(WriteError, match="ended and was replaced: the robot's watchdog"):
            writer.keep_alive()
        opened[1].close()


@pytest.mark.parametrize("also", [set[str](), {"servoStop"}])
def test_a_refused_watchdog_leaves_no_script_of_ours_running(also: set[str]) -> None:
    servo = Servo()
    servo.library.refused = {"setWatchdog", *also}
    with pytest.raises(WriteError, match="refused the watchdog"):
        servo.arm(state(runtime_state=STOPPED), lambda: None)
    assert servo.library.calls[-1] == ("stopScript",)


@pytest.mark.parametrize(
    ("runtime_state", "named"),
    [(0, "in runtime_state 0"), (PLAYING, "running"), (3, "in"), (PAUSED, "paused"), (5, "in")],
)
def test_a_program_that_is_not_stopped_is_not_ended_by_arming(
    runtime_state: int, named: str
) -> None:
    servo = Servo()
    with pytest.raises(WriteError, match=f"found a program {named}"):
        servo.arm(state(runtime_state=runtime_state), lambda: servo.clock.sleep(CYCLE))
    assert not servo.library.calls


def test_a_program_that_is_about_to_stop_is_waited_for() -> None:
    servo, coming = Servo(), [*[0] * 20, STOPPED]

    def look() -> RobotState:
        servo.clock.sleep(CYCLE)
        return state(runtime_state=coming.pop(0))

    servo.arm(state(runtime_state=PLAYING), look)
    assert not coming
    assert servo.library.calls[0] == ("opened",)


def test_a_program_started_after_the_judged_sample_is_not_ended_by_arming() -> None:
    servo = Servo()
    with pytest.raises(WriteError, match="found a program running"):
        servo.arm(state(runtime_state=STOPPED), lambda: state(runtime_state=PLAYING))
    assert not servo.library.calls


@pytest.mark.parametrize("kind", [Servo, Offset])
@pytest.mark.parametrize(
    "stopped", [{"safety_mode": 3}, {"robot_mode": 5}, {"safety_status_bits": 1 << 2}]
)
def test_a_stopped_robot_is_not_armed(kind: Any, stopped: dict[str, int]) -> None:
    writer = kind()
    with pytest.raises(WriteError, match="expected robot_mode 7"):
        writer.arm(state(**stopped), lambda: None)
    assert not writer.library.calls


def test_what_the_library_raises_is_a_failed_write_in_one_line(servo: Servo) -> None:
    servo.library.broken = True
    stopped = state(runtime_state=STOPPED)
    for action in (
        lambda: servo.arm(stopped, lambda: None),
        lambda: servo.write(setpoint(), state()),
        servo.release,
    ):
        with pytest.raises(
            WriteError, match=r"^192\.0\.2\.7: is\w+: write: Broken pipe \[system:32\]$"
        ):
            action()
    again = Servo()
    again.library.broken = True
    with pytest.raises(WriteError, match=r"setWatchdog: write: Broken pipe"):
        again.arm(stopped, lambda: None)


def test_the_last_target_is_cleared_before_a_new_script_could_go_there(servo: Servo) -> None:
    servo.write(setpoint(), state())
    servo.library.refused = {"isProgramRunning"}  # it was stopped, by whatever
    servo.library.calls.clear()
    with pytest.raises(WriteError, match="the control script does not start"):
        servo.arm(state(runtime_state=STOPPED), lambda: None)
    names = [call[0] for call in servo.library.calls]
    assert names.index("stopScript") < names.index("reuploadScript")


@pytest.mark.parametrize("connected", [True, False])
def test_letting_go_of_a_script_that_is_stopped_or_paused_clears_the_last_target(
    servo: Servo, connected: bool
) -> None:
    servo.library.refused = {"isProgramRunning"} if connected else {
        "isProgramRunning", "isConnected"
    }  # fmt: skip
    servo.library.calls.clear()
    servo.release()
    named = {name for name, *_ in servo.library.calls} - {"isProgramRunning", "isConnected"}
    assert named == ({"stopScript"} if connected else set())  # else the library reconnects


def test_letting_go_brakes_and_then_ends_the_script(servo: Servo) -> None:
    servo.library.calls.clear()
    servo.release()
    assert servo.library.calls[-2:] == [("servoStop", SETTINGS.stop_deceleration), ("stopScript",)]
    servo.library.refused = {"servoStop"}
    with pytest.raises(WriteError, match="refused servoStop"):
        servo.release()
    assert servo.library.calls[-1] == ("stopScript",)
    assert {call[0] for call in servo.library.calls} <= {"opened", *CONTROL}


def test_an_offset_arrives_in_its_registers_and_its_number_last(offset: Offset) -> None:
    number = registers.next_sequence(offset._sequence)
    offset.write(setpoint(offset=[1e-3, -2e-3, 3e-6, 4e-3, -5e-3, 6e-9]), state())
    units = [1_000_000, -2_000_000, 3_000, 4_000_000, -5_000_000, 6]
    doubles = dict(offset.library.of("setInputDoubleRegister"))
    sent = [doubles[register] for register in registers.OFFSET_DOUBLES]
    assert sent == pytest.approx([1e-3, -2e-3, 3e-6, 4e-3, -5e-3], abs=1e-12)
    integers = dict(offset.library.of("setInputIntRegister"))
    total = sum(units) + (round(0.04 / 4e-5) << 16 | round(0.08 / 1e-4)) + 31 * number
    assert integers[registers.OFFSET_RZ] == 6
    assert integers[registers.CHECKSUM] == total % 2**31
    assert integers[registers.HEARTBEAT] == integers[registers.SEQUENCE] == number
    assert offset.library.calls[-1][:2] == ("setInputIntRegister", registers.SEQUENCE)


def test_letting_go_of_an_offset_sends_nothing(offset: Offset) -> None:
    """The robot's program ramps it out by itself; a zero would be a step."""
    offset.write(setpoint(offset=[1e-3, 0, 0, 0, 0, 0]), state())
    offset.library.calls.clear()
    offset.release()
    assert not offset.library.calls


def test_an_offset_that_is_not_echoed_in_time_ends_the_stream(offset: Offset) -> None:
    offset.echoes = False
    begun = offset.clock.now
    offset.write(setpoint(), state())
    assert offset.unanswered_since() == begun
    while True:
        offset.look()
        if offset.clock.now - begun > SETTINGS.echo:
            break
        offset.keep_alive()
    for call in (offset.keep_alive, lambda: offset.write(setpoint(), state())):
        with pytest.raises(WriteError, match="offsets do not arrive"):
            call()


def test_an_offset_that_is_echoed_is_outstanding_no_more(offset: Offset) -> None:
    for _ in range(200):
        offset.write(setpoint(), state())
        offset.look()
    assert offset.unanswered_since() == np.inf


def test_arming_takes_a_number_that_no_earlier_session_can_have_sent() -> None:
    """Else the echo of the session before would confirm what has not arrived."""
    offset = Offset()
    offset.echoes = False
    with pytest.raises(WriteError, match="offsets do not arrive"):
        offset.arm(state(runtime_state=PLAYING), offset.look)


@pytest.mark.parametrize("ends", [True, False])
def test_arming_waits_for_a_former_offset_to_ramp_out(ends: bool) -> None:
    offset = Offset()
    offset.applied[2] = 1e-3

    def look() -> None:
        if ends:
            offset.applied[2] = max(offset.applied[2] - 1e-5, 0.0)
        assert not offset.library.calls or not offset.applied.any()
        offset.look()

    offset.note_answer(17, registers.Program.RUNNING, offset.applied)
    if ends:
        offset.arm(state(runtime_state=PLAYING), look)
        return
    with pytest.raises(WriteError, match=r"still applies an offset of 1\.000 mm"):
        offset.arm(state(runtime_state=PLAYING), look)
    assert not offset.library.calls


@pytest.mark.parametrize(
    "answer", [(registers.Program.ABSENT, PLAYING), (registers.Program.RUNNING, STOPPED)]
)
def test_offsets_need_the_robots_program(answer: tuple[int, int]) -> None:
    offset = Offset()
    offset.note_answer(17, answer[0], offset.applied)
    with pytest.raises(WriteError, match="expected a running robot program"):
        offset.arm(state(runtime_state=answer[1]), offset.look)


@pytest.mark.parametrize("sequence", [1, 499_999, 500_001, 750_000, registers.LAST_SEQUENCE])
def test_an_echo_of_zero_reaches_no_number(sequence: int) -> None:
    assert registers.reached(sequence, sequence)
    assert registers.reached(registers.next_sequence(sequence), sequence)
    assert not registers.reached(0, sequence)


def test_no_offset_is_sent_to_a_program_that_is_gone(offset: Offset) -> None:
    offset.write(setpoint(offset=[1e-3, 0, 0, 0, 0, 0]), state())
    offset.library.calls.clear()
    offset.note_answer(0, registers.Program.ABSENT, offset.applied)
    assert offset.unanswered_since() == offset.clock.now  # nothing has come back
    with pytest.raises(WriteError, match="the robot's program has ended"):
        offset.write(setpoint(offset=[1e-3, 0, 0, 0, 0, 0]), state())
    assert not offset.library.calls


@pytest.mark.parametrize(("rate", "turn"), [(0.05, 0.1), (0.0499, 0.09999), (0.01, 0.02)])
def test_the_robots_program_is_never_given_more_than_the_cells_rates(
    rate: float, turn: float
) -> None:
    packed = registers.rates(rate, turn)
    assert rate - 4e-5 < (packed >> 16) * 4e-5 <= rate + 1e-12
    assert turn - 1e-4 < (packed & 0xFFFF) * 1e-4 <= turn + 1e-12
