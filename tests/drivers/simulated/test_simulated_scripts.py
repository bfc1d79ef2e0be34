from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import pytest
from patience import PATIENCE
from rtde_client import RtdeClient
from simulated_cell import Bench, cell_settings
from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.ur.controller import Controller
from gapbridge.drivers.simulated.ur.modes import PAUSED
from gapbridge.drivers.simulated.ur.programs.script_text import (
    Pose,
    parse_assignment,
    parse_call,
    take_script,
)
from gapbridge.drivers.simulated.ur.servers.rtde_protocol import output_recipe
from gapbridge.drivers.simulated.ur.servers.script_server import ScriptServer
from gapbridge.drivers.simulated.ur.settings import make_controller, simulated_cell

FIELDS = (
    "actual_q,runtime_state,output_int_register_3,output_double_register_4,payload,tcp_offset,"
    "actual_digital_output_bits,safety_mode,output_int_register_0,output_int_register_1,target_q"
)
Q = (0.0, -1.5, 1.8, -1.87, -1.57, 0.0)


class Robot:
    """Script port, dashboard and RTDE of one controller."""

    def __init__(self, host: str) -> None:
        self.state = RtdeClient(host)
        self.state.outputs(FIELDS)
        self.recipe, _ = self.state.inputs(
            "input_int_register_0,input_int_register_1,"
            + ",".join(f"input_double_register_{i}" for i in range(13))
        )
        self.state.start()
        self._script = socket.create_connection((host, 30003), timeout=PATIENCE)
        self._dashboard = socket.create_connection((host, 29999), timeout=PATIENCE)
        self._lines = self._dashboard.makefile("r")
        self._lines.readline()

    def upload(self, text: str) -> None:
        self._script.sendall(text.encode())

    def ask(self, line: str) -> str:
        self._dashboard.sendall(line.encode() + b"\n")
        return self._lines.readline().strip()

    def command(self, code: int, *numbers: float, integer: int = 0) -> None:
        values = [*numbers, *[0.0] * (13 - len(numbers))]
        self.state.write(self.recipe, "2i13d", code, integer, *values)

    def until(self, name: str, value: object) -> dict[str, object]:
        begun = time.monotonic()
        while (sample := self.state.sample())[name] != value:
            waited = time.monotonic() - begun
            assert waited < PATIENCE, f"{name} stayed {sample[name]}, expected {value}"
        return sample

    def play(self, text: str) -> dict[str, object]:
        """Upload a program, see it run and end."""
        self.upload(text)
        self.until("runtime_state", 2)
        return self.until("runtime_state", 1)

    def close(self) -> None:
        self.state.close()
        self._script.close()
        self._dashboard.close()


@pytest.fixture
def robot(controller: SimulatedController) -> Iterator[Robot]:
    found = Robot(controller.host)
    yield found
    found.close()


CONTROL = (
    "def rtde_control():\n    global a = # float register offset\n0\n"
    "    global b = # int register offset\n0\nend\n"
)


@pytest.fixture
def control(robot: Robot) -> Robot:
    robot.upload(CONTROL)
    robot.until("output_int_register_0", 1)
    return robot


def test_a_program_of_plain_calls_runs_line_by_line(robot: Robot) -> None:
    sample = robot.play(
        "def job():\n"
        "  goal = [0.05, -1.5, 1.8, -1.87, -1.57, d2r(0)]\n"
        "  movej(goal, a=4.0, v=2.0)\n"
        "  movel(p[-0.6, -0.2, 0.5, 2.2, 2.2, 0.0], a=4, v=1)\n"
        "  movej(p[-0.6, -0.2, 0.5, 2.2, 2.2, 0.0])\n"
        "  write_output_integer_register(3, 40 + 2)\n"
        "  write_output_float_register(4, -1 / 4)\n"
        "  set_tcp(p[0, 0, 0.2, 0, 0, 0])\n"
        "  set_payload(2.5, [0, 0, 0.1])\n"
        "  set_standard_digital_out(2, True)\n"
        '  zero_ftsensor()\n  sync()\n  stopj(2.0)\n  textmsg("done")\n'
        "end\n"
    )
    assert sample["output_int_register_3"] == 42
    assert sample["output_double_register_4"] == -0.25
    assert sample["payload"] == 2.5
    assert sample["tcp_offset"] == [0.0, 0.0, 0.2, 0.0, 0.0, 0.0]
    assert sample["actual_digital_output_bits"] == 4
    assert sample["actual_q"] != pytest.approx(Q, abs=1e-3)


def test_a_single_line_is_a_program_and_a_secondary_one_does_not_stop_it(robot: Robot) -> None:
    robot.upload(f"movej([0.3, {', '.join(map(str, Q[1:]))}], a=1.0, v=0.5)\n")
    robot.until("runtime_state", 2)
    robot.upload("sec note():\n  write_output_integer_register(3, 7)\nend\n")
    sample = robot.until("output_int_register_3", 7)
    assert sample["runtime_state"] == 2
    assert robot.until("runtime_state", 1)["target_q"][0] == pytest.approx(0.3)  # type: ignore[index]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("movel(p[3.0, 0, 0.5, 0, 0, 0], a=50, v=50)", "leaves the workspace"),
        ("movej(p[3.0, 0, 0.5, 0, 0, 0])", "no joints reach that pose"),
        ("movej([1, 2, 3])", "needs six numbers"),
        ("movej([0, -1.5, 1.8, -1.87, -1.57, 0], a=0)", "must be positive"),
        ("set_tcp([1, 2])", "stops"),
    ],
)
def test_a_wrong_line_stops_the_program_with_the_reason_in_the_log(
    controller: SimulatedController, robot: Robot, line: str, reason: str
) -> None:
    robot.upload(f"def job():\n  {line}\n  write_output_integer_register(3, 1)\nend\n")
    robot.until("runtime_state", 2)
    sample = robot.until("runtime_state", 1)
    assert sample["output_int_register_3"] == 0
    assert reason in controller.log()
    assert robot.play("def job():\n  sleep(0.01)\nend\n")["safety_mode"] == 1


class Upload:
    """Script text on its way to the port, without a socket."""

    def __init__(self, text: str) -> None:
        self.received = bytearray(text.encode())


def after_upload(text: str) -> Controller:
    """Return a controller of this process that has run an uploaded program for 0.4 s."""
    controller = make_controller(simulated_cell("ur5e"))
    ScriptServer(controller).handle(Upload(text))  # type: ignore[arg-type]
    recipe = output_recipe([*FIELDS.split(","), "output_int_register_12"], version=2, every=1)
    for _ in range(200):
        controller.cycle()
        recipe.encode(controller.memory)  # as a client's packet: it must always be possible
    return controller


@pytest.mark.parametrize(
    "line",
    [
        "write_output_integer_register(12, 3.7)",
        "write_output_integer_register(12, 3000000000)",
        "write_output_integer_register(99, 1)",
        "write_output_float_register(12, p[1, 2, 3, 0, 0, 0])",
        "write_output_string_register(0, 1)",
        "write_output_boolean_register()",
        "set_standard_digital_out(70, True)",
        "set_digital_out(-1, True)",
        "set_payload(1.0, 0.5)",
        "set_tcp(3)",
        'sleep("a")',
    ],
)
def test_a_value_that_a_register_cannot_hold_stops_the_program_and_not_the_controller(
    line: str, caplog: pytest.LogCaptureFixture
) -> None:
    controller = after_upload(f"def job():\n  {line}\n  set_payload(3.0)\nend\n")
    assert controller.program is None
    assert controller.declared.payload_mass != 3.0
    assert "program job stops: " in caplog.text
    assert "Traceback" not in caplog.text
    assert len(controller.memory) == len(make_controller(simulated_cell("ur5e")).memory)


@pytest.mark.parametrize(
    "line", ["movej([0.5, -1.5, 1.8, -1.87, -1.57, 0.0])", "movej(3)", "stopl(2.0)"]
)
def test_a_secondary_program_does_not_move_the_arm(
    line: str, caplog: pytest.LogCaptureFixture
) -> None:
    controller = after_upload(f"sec note():\n  {line}\n  set_payload(3.0)\nend\n")
    assert controller.target_q == Q
    assert controller.declared.payload_mass != 3.0
    assert "in a secondary program, which cannot move the arm" in caplog.text


def test_a_program_that_a_protective_stop_meets_before_its_first_line_is_paused() -> None:
    controller = make_controller(simulated_cell("ur5e"))
    line = "movej([0.5, -1.5, 1.8, -1.87, -1.57, 0.0])\n"
    ScriptServer(controller).handle(Upload(line))  # type: ignore[arg-type]
    controller.cycle()
    controller.protective_stop()
    for _ in range(100):
        controller.cycle()
    assert controller.memory["runtime_state"] == PAUSED
    assert controller.target_q == Q


def test_a_setpoint_that_is_no_number_stops_the_program_and_not_the_arm_elsewhere(
    controller: SimulatedController, control: Robot
) -> None:
    control.command(11, float("nan"), *Q[1:], 0.5, 0.5, 0.002, 0.1, 300.0)
    sample = control.until("runtime_state", 1)
    assert sample["actual_q"] == pytest.approx(Q)
    assert "is not finite" in controller.log()


def test_an_unknown_command_is_done_at_once_and_logged(
    controller: SimulatedController, control: Robot
) -> None:
    control.command(199)
    control.until("output_int_register_0", 2)
    control.command(0)
    control.until("output_int_register_0", 1)
    assert "command 199 is unknown" in controller.log()


def test_a_goal_beyond_the_joint_limits_is_a_protective_stop(control: Robot) -> None:
    control.command(1, 0.0, -1.5, 3.3, -1.87, -1.57, 0.0, 3.0, 20.0)
    sample = control.until("safety_mode", 3)
    assert sample["runtime_state"] == 4
    assert sample["target_q"][2] <= 3.1415927  # type: ignore[index]


def test_a_move_goes_on_after_a_pause(control: Robot) -> None:
    control.command(1, 0.4, *Q[1:], 0.5, 2.0)
    control.until("output_int_register_0", 1)
    time.sleep(0.3)
    assert control.ask("pause") == "Pausing program"
    assert control.ask("pause") == "Failed to execute: pause"
    control.until("runtime_state", 4)
    for _ in range(100):
        paused = control.state.sample()
    for _ in range(50):
        still = control.state.sample()
    assert still["target_q"] == paused["target_q"]
    assert 0.0 < still["target_q"][0] < 0.4
    assert control.ask("play") == "Starting program"
    done = control.until("output_int_register_0", 2)
    assert done["target_q"] == pytest.approx((0.4, *Q[1:]))


def test_a_search_for_contact_stops_when_something_pushes_back(
    control: Robot, bench: Bench
) -> None:
    control.command(51, 0.0, 0.0, -0.02, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5)
    control.until("runtime_state", 2)
    time.sleep(0.2)
    bench.do("wrench 0 0 40 0 0 0")
    control.until("output_int_register_0", 2)
    control.command(0)
    control.until("output_int_register_0", 1)
    control.command(63)
    assert control.until("output_int_register_0", 2)["output_int_register_1"] == 1


def test_the_speed_slider_slows_moves_down() -> None:
    settings = cell_settings()
    with SimulatedController(settings):
        robot = Robot(settings.host)
        slider, _ = robot.state.inputs("speed_slider_mask,speed_slider_fraction")
        robot.state.write(slider, "Id", 1, 0.1)
        robot.upload(f"movej([0.3, {', '.join(map(str, Q[1:]))}], a=10.0, v=1.0)\n")
        robot.until("runtime_state", 2)
        for _ in range(250):
            sample = robot.state.sample()
        robot.close()
    assert 0.005 < sample["target_q"][0] < 0.02


def test_the_dashboard_answers_what_it_does_not_know(robot: Robot) -> None:
    assert robot.ask("make coffee") == 'could not understand: "make coffee"'
    assert robot.ask("load nothing") == "File not found: nothing"
    assert robot.ask("play") == "Failed to execute: play"
    assert robot.ask("version") == "5.15.0.0"
    assert robot.ask("setUserRole programmer") == "Setting user role: programmer"
    assert robot.ask("set operational mode manual") == "Operational mode 'manual' is set"
    assert robot.ask("get operational mode") == "MANUAL"
    assert "brake release" in robot.ask("help")
    assert robot.ask("restart safety") == "Restarting safety"
    assert robot.ask("robotmode") == "Robotmode: POWER_OFF"
    robot.upload("movej([0, 0, 0, 0, 0, 0])\n")
    time.sleep(0.1)
    assert robot.ask("running") == "Program running: false"


def test_programs_are_cut_out_of_the_stream_at_an_end_in_the_first_column() -> None:
    stream = bytearray(b"# comment\ndef a():\n  if x:\n  end\nend\nstopj(2)\ndef b():\n  sync()\n")
    first, second = take_script(stream), take_script(stream)
    assert first is not None
    assert second is not None
    assert (first.name, first.lines) == ("a", ("  if x:", "  end"))
    assert (second.kind, second.name) == ("line", "stopj(2)")
    assert take_script(stream) is None
    stream += b"end\n"
    third = take_script(stream)
    assert third is not None
    assert third.name == "b"
    assert stream == b""


def test_calls_are_read_with_poses_names_and_arithmetic() -> None:
    call = parse_call("movel(p[1, 2*3, -x, 0, 0, d2r(180)], a=1.5 - 0.5)", {"x": 4})
    assert call is not None
    assert call.arguments[0] == pytest.approx(Pose((1, 6, -4, 0, 0, 3.141592653589793)))
    assert isinstance(call.arguments[0], Pose)
    assert call.get(1, "a", None) == 1.0
    assert parse_call("while True:") is None
    assert parse_call("movej(unknown)") is None
    assert parse_assignment("global y = [1, 2]", {}) == ("y", (1, 2))
    assert parse_assignment("y == 2", {}) is None
