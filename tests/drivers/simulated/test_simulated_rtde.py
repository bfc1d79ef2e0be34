from __future__ import annotations

import socket
import struct
import time
from itertools import pairwise

import pytest
from patience import wait_for
from rtde_client import RtdeClient
from simulated_cell import cell_settings
from simulated_controller import SimulatedController

from gapbridge.drivers.simulated.server.connection import listen
from gapbridge.drivers.simulated.ur.rtde_names import INPUTS, OUTPUTS
from gapbridge.drivers.simulated.ur.servers.rtde_server import RtdeServer
from gapbridge.drivers.simulated.ur.settings import make_controller


@pytest.mark.parametrize("version", [1, 2])
def test_a_raw_session_reads_typed_values_in_both_protocol_versions(
    controller: SimulatedController, version: int
) -> None:
    client = RtdeClient(controller.host, version)
    assert struct.unpack(">4I", client.ask("v")) == (5, 15, 0, 0)
    names = "timestamp,actual_q,payload_cog,joint_mode,robot_mode,runtime_state,tool_output_mode"
    types = client.outputs(names + ",actual_digital_input_bits,output_bit_register_64")
    assert types == [
        "DOUBLE", "VECTOR6D", "VECTOR3D", "VECTOR6INT32", "INT32", "UINT32", "UINT8",
        "UINT64", "BOOL",
    ]  # fmt: skip
    assert client.start()
    sample = client.sample()
    assert sample["actual_q"] == pytest.approx(controller.settings.start_q)
    assert sample["robot_mode"] == 7
    assert sample["runtime_state"] == 1
    assert sample["joint_mode"] == [253] * 6


def test_every_output_name_can_be_read(controller: SimulatedController) -> None:
    names = list(OUTPUTS)
    for first in range(0, len(names), 50):
        chunk = names[first : first + 50]
        client = RtdeClient(controller.host)
        assert client.outputs(",".join(chunk)) == [OUTPUTS[name] for name in chunk]
        assert client.start()
        assert set(client.sample()) == set(chunk)
        client.close()


def test_a_trailing_comma_names_nothing(controller: SimulatedController) -> None:
    client = RtdeClient(controller.host)
    assert client.outputs("timestamp,actual_q,") == ["DOUBLE", "VECTOR6D"]
    assert client.inputs("input_int_register_20,") == (1, ["INT32"])


def test_an_unknown_output_is_named_and_start_is_refused(controller: SimulatedController) -> None:
    client = RtdeClient(controller.host)
    assert client.outputs("timestamp,actual_elbow") == ["DOUBLE", "NOT_FOUND"]
    assert not client.start()


def test_packets_come_every_cycle_and_timestamps_advance_by_two_milliseconds(
    controller: SimulatedController,
) -> None:
    client = RtdeClient(controller.host)
    client.outputs("timestamp")
    client.start()
    stamps = [client.sample()["timestamp"] for _ in range(500)]
    steps = [b - a for a, b in pairwise(stamps)]
    assert steps == pytest.approx([0.002] * 499, abs=1e-9)


@pytest.mark.parametrize(("asked", "every"), [(500, 1), (400, 1), (250, 2), (125, 4), (10, 50)])
def test_the_output_rate_is_divided_as_a_controller_does(
    controller: SimulatedController, asked: float, every: int
) -> None:
    client = RtdeClient(controller.host)
    client.outputs("timestamp", asked)
    client.start()
    first, second = client.sample()["timestamp"], client.sample()["timestamp"]
    assert second - first == pytest.approx(0.002 * every, abs=1e-9)


def test_an_input_of_another_connection_is_in_use_until_that_closes(
    controller: SimulatedController,
) -> None:
    owner, other = RtdeClient(controller.host), RtdeClient(controller.host)
    assert owner.inputs("input_int_register_5,input_int_register_6")[0] == 1
    assert owner.inputs("input_int_register_5") == (2, ["INT32"])
    assert other.inputs("input_int_register_4,input_int_register_6") == (0, ["INT32", "IN_USE"])
    owner.close()
    wait_for(
        lambda: (
            other.inputs("input_int_register_4,input_int_register_6") == (1, ["INT32", "INT32"])
        ),
        "the inputs",
    )


def test_inputs_are_taken_without_start_and_keep_their_last_value(
    controller: SimulatedController,
) -> None:
    writer = RtdeClient(controller.host)
    recipe, _ = writer.inputs("input_int_register_30,input_double_register_31")
    writer.write(recipe, "id", -5, 2.5)
    reader = RtdeClient(controller.host)
    reader.outputs("input_int_register_30,input_double_register_31")
    reader.start()
    written = {"input_int_register_30": -5, "input_double_register_31": 2.5}
    wait_for(lambda: reader.sample() == written, "the values")
    writer.close()
    for _ in range(65):
        assert reader.sample() == written


def test_of_a_short_input_packet_what_fits_is_taken_and_the_length_is_logged(
    controller: SimulatedController,
) -> None:
    client = RtdeClient(controller.host)
    recipe, _ = client.inputs("input_int_register_30,input_double_register_31")
    client.outputs("input_int_register_30,input_double_register_31")
    client.write(recipe, "i", 77)
    client.start()
    for _ in range(5):
        sample = client.sample()
    assert sample == {"input_int_register_30": 77, "input_double_register_31": 0.0}
    assert "what fits is taken" in controller.log()


def test_every_input_name_is_known(controller: SimulatedController) -> None:
    client = RtdeClient(controller.host)
    names = list(INPUTS)
    for first in range(0, len(names), 50):
        chunk = names[first : first + 50]
        number, types = client.inputs(",".join(chunk))
        assert number == first // 50 + 1
        assert types == [INPUTS[name] for name in chunk]


def test_digital_outputs_and_speed_slider_follow_their_masks(
    controller: SimulatedController,
) -> None:
    client = RtdeClient(controller.host)
    client.outputs("actual_digital_output_bits,speed_scaling,standard_analog_output1")
    digital, _ = client.inputs("standard_digital_output_mask,standard_digital_output")
    slider, _ = client.inputs("speed_slider_mask,speed_slider_fraction")
    analog, _ = client.inputs(
        "standard_analog_output_mask,standard_analog_output_type,"
        "standard_analog_output_0,standard_analog_output_1"
    )
    client.write(digital, "BB", 0b0110, 0b1111)
    client.write(slider, "Id", 1, 0.25)
    client.write(analog, "BBdd", 2, 2, 1e300, 0.5)
    client.start()
    for _ in range(5):
        sample = client.sample()
    assert sample["actual_digital_output_bits"] == 0b0110
    assert sample["speed_scaling"] == 0.25
    assert sample["standard_analog_output1"] == pytest.approx(5.0)


def test_pause_stops_the_packets_and_start_resumes_them(controller: SimulatedController) -> None:
    client = RtdeClient(controller.host)
    client.outputs("timestamp")
    client.start()
    before = client.sample()["timestamp"]
    assert client.ask("P") == b"\x01"
    time.sleep(0.1)
    assert client.start()
    assert client.sample()["timestamp"] - before > 0.09


@pytest.mark.parametrize("size", [0, 2])
def test_a_frame_that_cannot_be_closes_only_its_own_connection(
    controller: SimulatedController, size: int
) -> None:
    healthy = RtdeClient(controller.host)
    healthy.outputs("timestamp")
    healthy.start()
    broken = socket.create_connection((controller.host, 30004), timeout=5)
    broken.sendall(struct.pack(">HB", size, ord("V")))
    assert broken.recv(10) == b""
    assert healthy.sample()["timestamp"] > 0.0


def test_a_client_that_does_not_read_is_skipped_and_closed() -> None:
    settings = cell_settings()
    server = RtdeServer(make_controller(settings), (5, 15, 0, 0))
    listener = listen(settings.host, 0)
    listener.setblocking(True)
    client = socket.socket()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    client.connect(listener.getsockname())
    session = server.accept(listener.accept()[0])
    body = b"timestamp,actual_q,target_q,actual_TCP_pose"
    client.sendall(struct.pack(">HB", 3 + len(body), ord("O")) + body)
    client.sendall(struct.pack(">HB", 3, ord("S")))
    time.sleep(0.05)
    session.read()
    server.handle(session)
    packets = 0
    while session.open and packets < 60000:
        server.publish(0.002)
        packets += 1
        assert len(session.pending) < 200  # at most the rest of one packet waits
    assert not session.open
    assert packets > 5000  # 10 s of silence
    server.drop_closed()
    assert server.sessions == []
    client.close()
    listener.close()
