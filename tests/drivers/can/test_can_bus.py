import itertools
import socket
import threading
import time

import can
import pytest
from canopen.network import Network
from patience import PATIENCE, wait_for
from pydantic import ValidationError

from gapbridge.core.errors import LinkError
from gapbridge.drivers.can.loading import read_profile
from gapbridge.drivers.can.reader import FrameReader
from gapbridge.drivers.can.settings import CanSettings
from gapbridge.drivers.can_bus.bus import BusSettings, close_bus, open_bus
from gapbridge.drivers.canopen.listening import BusListener
from gapbridge.drivers.canopen.profile import read_profile as read_canopen_profile
from gapbridge.drivers.canopen.settings import CanopenSettings
from gapbridge.drivers.canopen.sync_set import SyncCollector
from gapbridge.drivers.clock import SYSTEM
from gapbridge.drivers.simulated.can.frame import Frame
from gapbridge.drivers.simulated.can.hub import Hub


@pytest.fixture
def hub():
    with Hub(SYSTEM) as served:
        yield served


def settings_of(hub, **more):
    return BusSettings(interface="socketcand", channel="can0", host=hub.host, port=hub.port, **more)


def joined(hub, number):
    """Return buses that hear every frame from now on."""
    buses = [open_bus(settings_of(hub)) for _ in range(number)]
    time.sleep(0.05)  # the server sends no frame for 20 ms after the handshake
    return buses


def frames_of(bus, number):
    found = itertools.takewhile(bool, (bus.recv(PATIENCE) for _ in range(number)))
    return [(f.arbitration_id, bytes(f.data), f.is_extended_id) for f in found]


def test_a_frame_on_the_hub_reaches_every_other_connection_and_not_its_sender(hub):
    buses = joined(hub, 3)
    buses[0].send(can.Message(arbitration_id=0x155, data=[1, 2, 3], is_extended_id=False))
    buses[0].send(can.Message(arbitration_id=0x1ABCDEF0, data=[], is_extended_id=True))
    wanted = [(0x155, b"\1\2\3", False), (0x1ABCDEF0, b"", True)]
    assert frames_of(buses[1], 2) == wanted
    assert frames_of(buses[2], 2) == wanted
    assert buses[0].recv(0.05) is None
    for bus in buses:
        close_bus(bus)


def test_a_serial_adapter_and_a_socketcand_client_share_the_bus(hub):
    serial = open_bus(BusSettings(interface="slcan", channel=hub.add_terminal()))
    (tcp,) = joined(hub, 1)
    serial.send(can.Message(arbitration_id=0x2A5, data=range(8), is_extended_id=False))
    assert frames_of(tcp, 1) == [(0x2A5, bytes(range(8)), False)]
    tcp.send(can.Message(arbitration_id=0x12345, data=[9], is_extended_id=True))
    assert frames_of(serial, 1) == [(0x12345, b"\x09", True)]
    close_bus(serial)
    close_bus(tcp)


def test_a_serial_adapters_backlog_is_read_in_pieces_once_and_in_order(hub):
    serial = open_bus(BusSettings(interface="slcan", channel=hub.add_terminal()))
    (tcp,) = joined(hub, 1)
    serial.send(can.Message(arbitration_id=1, is_extended_id=False))
    assert frames_of(tcp, 1) == [(1, b"", False)]  # the adapter is open
    reads, port = [], serial.serialPortOrig._port
    read = port.read
    port.read = lambda size=1: reads.append(read(size)) or reads[-1]
    for i in range(300):
        tcp.send(can.Message(arbitration_id=i, data=i.to_bytes(2, "big"), is_extended_id=False))
    got = frames_of(serial, 300)
    assert [(i, int.from_bytes(data, "big")) for i, data, _ in got] == [(i, i) for i in range(300)]
    assert serial.recv(0.0) is None
    assert max(map(len, reads)) > 27  # python-can alone: one byte a read
    serial.send(can.Message(arbitration_id=0x155, data=[1]), timeout=0.5)
    assert serial.serialPortOrig.write_timeout == port.write_timeout == 0.5
    tcp.send(can.Message(arbitration_id=7, data=[1], is_extended_id=False))
    wait_for(lambda: port.in_waiting >= len("t007101\r"), "the frame's text")
    serial.serialPortOrig.reset_input_buffer()
    assert serial.serialPortOrig.in_waiting == 0
    assert serial.recv(0.05) is None
    close_bus(serial)
    close_bus(tcp)


def test_thousands_of_frames_arrive_once_and_in_order(hub):
    sender, receiver = joined(hub, 2)
    for i in range(3000):
        sender.send(can.Message(arbitration_id=i % 0x7FF, data=i.to_bytes(4, "big")))
    got = frames_of(receiver, 3000)
    assert [int.from_bytes(data, "big") for _, data, _ in got] == list(range(3000))
    close_bus(sender)
    close_bus(receiver)


def test_the_end_of_the_hub_is_reported_instead_of_spinning(hub):
    bus = open_bus(settings_of(hub))
    hub.close()
    before = time.process_time()
    with pytest.raises(can.CanError, match="closed the connection"):
        bus.recv(1.0)
    assert time.process_time() - before < 0.5
    close_bus(bus)


def test_a_hub_that_nobody_serves_is_one_line_and_no_busy_loop():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    before = time.process_time()  # the library alone would try for 10 s at full load
    with pytest.raises(LinkError, match=rf"socketcand can0@127.0.0.1:{port}: cannot be reached"):
        open_bus(BusSettings(interface="socketcand", port=port))
    assert time.process_time() - before < 1.0


def test_joining_a_busy_bus_takes_no_luck(hub):
    ended = threading.Event()

    def chatter():
        while not ended.wait(0.0005):
            hub.send(Frame(0x2A5, bytes(8)))

    thread = threading.Thread(target=chatter)
    thread.start()
    try:
        for _ in range(30):
            bus = open_bus(settings_of(hub))
            assert frames_of(bus, 1) == [(0x2A5, bytes(8), False)]
            close_bus(bus)
    finally:
        ended.set()
        thread.join()


def test_garbage_from_a_client_harms_nobody_else(hub):
    bus, other = joined(hub, 2)
    with socket.create_connection((hub.host, hub.port)) as bogus:
        bogus.sendall(b"< send zzz 8 1 >< send 155 2 1 ><send 155 1 100 >< nonsense >" + b"x" * 500)
        bus.send(can.Message(arbitration_id=1, data=[1], is_extended_id=False))
        assert frames_of(other, 1) == [(1, b"\1", False)]
    close_bus(bus)
    close_bus(other)


def test_an_interface_that_python_can_lacks_is_refused_with_those_it_has():
    with pytest.raises(ValidationError, match=r"expected one of .*socketcand"):
        BusSettings(interface="soketcan")


def test_a_socketcan_channel_that_is_not_there_is_one_line():
    with pytest.raises(LinkError, match="socketcan nowhere0: cannot be opened"):
        open_bus(BusSettings(interface="socketcan", channel="nowhere0"))


def test_an_interface_without_its_library_is_one_line(monkeypatch):
    """As kvaser's without its: a name of it is not defined."""

    def bus(**given):
        raise NameError("name 'canGetNumberOfChannels' is not defined")

    monkeypatch.setattr(can, "Bus", bus)
    with pytest.raises(LinkError, match=r"^kvaser 0: cannot be opened: .* library installed\?\)$"):
        open_bus(BusSettings(interface="kvaser", channel="0"))


class Received:
    """A bus on which these frames have arrived."""

    def __init__(self, *frames):
        self._frames = list(frames)

    def recv(self, timeout):
        return self._frames.pop(0) if self._frames else None


@pytest.mark.parametrize(("interface", "is_heard"), [("socketcan", True), ("virtual", False)])
def test_on_socketcan_a_frame_of_another_program_on_this_computer_is_heard(interface, is_heard):
    """There ``is_rx`` is False for it; elsewhere such a frame is one of ours, come back."""
    settings = CanSettings(profile="piper", interface=interface)
    reader = FrameReader(settings, read_profile(settings.profile_path), SYSTEM)
    reader.bus = Received(
        can.Message(arbitration_id=0x2A5, data=bytes(8), is_extended_id=False, is_rx=False),
        can.Message(arbitration_id=0x155, data=bytes(8), is_extended_id=False, is_rx=False),
    )
    reader.newest()
    assert (reader.foreign is not None) == is_heard
    assert reader.identifiers == ({0x2A5, 0x155} if is_heard else set())

    drives = CanopenSettings(profile="cia402", interface=interface)
    profile = read_canopen_profile(drives.profile_path)
    listener = BusListener(Network(), drives, profile, SyncCollector(profile, SYSTEM), SYSTEM)
    listener.on_message_received(
        can.Message(arbitration_id=0x204, data=bytes(6), is_extended_id=False, is_rx=False)
    )
    assert (listener.foreign is not None) == is_heard


@pytest.mark.parametrize("interface", ["socketcan", "virtual"])
def test_echoes_of_our_own_frames_are_refused_where_they_look_like_others(interface):
    given = {"interface": interface, "options": {"receive_own_messages": True}}
    if interface == "virtual":
        assert CanSettings(profile="piper", **given).options
        return
    for kind, profile in ((CanSettings, "piper"), (CanopenSettings, "cia402")):
        with pytest.raises(ValidationError, match="no receive_own_messages on socketcan"):
            kind(profile=profile, **given)


def test_socketcan_where_vcan0_exists():
    try:
        one = open_bus(BusSettings(interface="socketcan", channel="vcan0"))
    except LinkError as error:
        pytest.skip(f"no vcan0 in this kernel: {error}")
    two = open_bus(BusSettings(interface="socketcan", channel="vcan0"))
    one.send(can.Message(arbitration_id=0x155, data=[7], is_extended_id=False))
    assert frames_of(two, 1) == [(0x155, b"\7", False)]
    close_bus(one)
    close_bus(two)
