"""What the profile does not name never reaches the bus."""

import pytest

from gapbridge.core.errors import GapbridgeError, WriteError
from gapbridge.drivers.canopen.master import AllowedFrames
from gapbridge.drivers.canopen.objects import Address
from gapbridge.drivers.canopen.profile import read_profile


@pytest.fixture
def profile(arm):
    return read_profile(arm.settings.profile_path)


@pytest.fixture
def allowed(profile):
    return AllowedFrames(profile)


@pytest.mark.parametrize(
    ("cob_id", "data"),
    [
        (0x000, bytes([1, 0])),  # NMT to all nodes, ours or not
        (0x000, bytes([0x81, 99])),  # NMT to a stranger
        (0x000, bytes([1])),
        (0x67F, bytes(8)),  # SDO to a node that is not ours
        (0x27F, bytes(8)),  # an RPDO of a stranger
        (0x100, bytes(8)),  # time stamp
        (0x7E5, bytes(8)),  # LSS: node ids and bit rates
        (0x183, bytes(8)),  # a TPDO, which only a drive sends
    ],
)
def test_a_frame_beyond_the_profile_raises(allowed, cob_id, data):
    with pytest.raises(WriteError, match="does not allow"):
        allowed.check(cob_id, data)


@pytest.mark.parametrize(
    "address",
    [
        Address(0x1010, 1),  # store parameters
        Address(0x1011, 1),  # restore defaults
        Address(0x607D, 1),  # software position limits
        Address(0x6065, 0),  # following error window
        Address(0x607C, 0),  # home offset
        Address(0x6040, 0),  # Controlword: by RPDO only
        Address(0x607A, 0),  # target: by RPDO only
        Address(0x2000, 0),  # the maker's own
    ],
)  # fmt: skip
def test_no_object_is_written_that_connecting_does_not_need(allowed, profile, address):
    node = profile.nodes[0]
    download = bytes([0x23, address.index & 0xFF, address.index >> 8, address.subindex, 0, 0, 0, 0])
    with pytest.raises(WriteError, match=str(address)):
        allowed.check(0x600 + node, download)
    allowed.check(0x600 + node, bytes([0x40]) + download[1:])  # reading it is


def test_a_write_in_segments_or_blocks_raises(allowed, profile):
    for first in (0x00, 0xC2):
        with pytest.raises(WriteError):
            allowed.check(0x600 + profile.nodes[0], bytes([first, 0x60, 0x60, 0, 0, 0, 0, 0]))


def test_the_library_itself_cannot_pass_the_list(arm, profile):
    driver = arm.driver()
    driver.connect()
    try:
        with pytest.raises(GapbridgeError, match="0x607D:1: the profile does not allow"):
            driver.master.write(profile.nodes[0], Address(0x607D, 1), 5)
        with pytest.raises(WriteError, match="does not allow"):
            driver.master.network.nmt.state = "PRE-OPERATIONAL"  # to all nodes
        with pytest.raises(GapbridgeError, match="does not allow"):
            driver.master.send(0x27F, bytes(8), "RPDO1 of node 127")
    finally:
        driver.close()
