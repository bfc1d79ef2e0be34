"""What a CANopen link may send, compiled from its profile; anything else raises before the bus."""

from __future__ import annotations

from gapbridge.core.errors import WriteError
from gapbridge.drivers.canopen.objects import (
    HEARTBEAT_BASE,
    NMT,
    PDO_COUNT,
    SDO_REQUEST_BASE,
    SYNC,
    Address,
)
from gapbridge.drivers.canopen.profile import CanopenProfile

ALWAYS: tuple[Address, ...] = (
    Address(0x1006, 0),  # SYNC period
    Address(0x1016, 1),  # consumer heartbeat: the drives watch us
    Address(0x1017, 0),  # producer heartbeat
    Address(0x6007, 0),  # abort connection option
    Address(0x6060, 0),  # modes of operation
    Address(0x60C2, 1),  # interpolation period
    Address(0x60C2, 2),
)
PDO_SETUP = (0x1400, 0x1600, 0x1800, 0x1A00)  # communication and mapping, of RPDOs and TPDOs
_DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = 1, 2, 3, 4  # SDO client command specifiers


class AllowedFrames:
    """The allow-list of one profile: identifiers, NMT nodes, objects that SDOs may write.

    No object of a drive's limits, gains, offsets or identity is among them, nor is a node that
    the profile does not have, nor NMT to all nodes.
    """

    def __init__(self, profile: CanopenProfile) -> None:
        self._name = profile.name
        self._nodes = frozenset(profile.nodes)
        self._plain = frozenset(
            {SYNC, HEARTBEAT_BASE + profile.heartbeat.our_node}
            | {layout.cob_id(node) for layout in profile.rpdo for node in profile.nodes}
        )
        self._sdo = frozenset(SDO_REQUEST_BASE + node for node in profile.nodes)
        self._indices = frozenset(
            base + number
            for base in (PDO_SETUP if profile.file.pdo_setup == "write" else ())
            for number in range(PDO_COUNT)
        )

    def check(self, cob_id: int, data: bytes) -> None:
        """Raise WriteError for a frame that the profile does not allow."""
        if cob_id in self._plain:
            return
        if cob_id in self._sdo:
            self._check_sdo(bytes(data), cob_id - SDO_REQUEST_BASE)
        elif cob_id != NMT or len(data) != 2 or data[1] not in self._nodes:
            raise WriteError(
                f"{self._name}: frame 0x{cob_id:03X} {bytes(data).hex(' ')}: the profile does not "
                "allow it to be sent"
            )

    def _check_sdo(self, data: bytes, node: int) -> None:
        command = data[0] >> 5 if data else -1
        if command in (_UPLOAD, _UPLOAD_SEGMENT, _ABORT):
            return
        address = Address(int.from_bytes(data[1:3], "little"), data[3] if len(data) > 3 else 0)
        if command == _DOWNLOAD and (address in ALWAYS or address.index in self._indices):
            return
        raise WriteError(
            f"{self._name}: node {node}: {address}: the profile does not allow it to be written"
        )
