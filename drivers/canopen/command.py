"""Setpoint -> RPDOs: all of them before a SYNC makes them count, or none."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gapbridge.core.arrays import Array
from gapbridge.core.errors import LinkError, WriteError
from gapbridge.drivers.canopen.master import Master
from gapbridge.drivers.canopen.profile import CanopenProfile

Frames = list[tuple[int, bytes, str]]
# that we command, in addition to the mode's target
OURS = ("Controlword", "Modes of operation")


class RpdoWriter:
    """Sends RPDOs of transmission type 1: drives act on them at the next SYNC, all at once.

    After a set that was sent in part the previous set is sent again; if that fails too, no SYNC is
    sent, so that the partial set never takes effect. A set whose SYNC comes too late (the process
    stood still in between) is replaced by the one in force in the same way.
    """

    def __init__(self, master: Master, profile: CanopenProfile) -> None:
        self._master, self._profile = master, profile
        self._image: list[dict[str, int]] = [{} for _ in profile.nodes]
        self._last: Frames = []
        self._in_force: tuple[Frames, Array | None] = [], None  # frames, target at the last SYNC
        self._expires = math.inf  # s, monotonic: after it, ``_last`` must not take effect any more
        self._lapsed = False  # see ``take_lapsed``
        self.partial = False  # the drives hold a part of a set, until a SYNC
        self.reverted = 0  # sets that were sent in part and reverted
        self.target: Array | None = None  # (n,) rad, of the last whole set

    def load(self) -> None:
        """Read the objects that we do not command from the drives. Raises LinkError."""
        self.reset()
        for joint, node in enumerate(self._profile.nodes):
            self._image[joint]["Modes of operation"] = self._profile.mode_number
            for layout in self._profile.rpdo:
                for entry in layout.entries:
                    if entry.name not in (*OURS, self._profile.target):
                        counts = self._master.read(node, entry.address)
                        self._image[joint][entry.name] = counts

    def reset(self) -> None:
        """Drop the last set: the drives' own state is valid now."""
        self._last, self.partial, self.target = [], False, None
        self._in_force, self._expires = ([], None), math.inf
        self._lapsed = False

    def take_lapsed(self) -> bool:
        """Return, once, whether a whole set was replaced by the one in force: too late a SYNC."""
        lapsed, self._lapsed = self._lapsed, False
        return lapsed

    def send(self, controlwords: Sequence[int], q: Array, expires: float = math.inf) -> None:
        """Send Controlwords and joint targets (n,), rad; they count at the next SYNC.

        If that SYNC is not sent before ``expires`` (s, monotonic), they never do. Raises WriteError
        if not all were sent; then none of them takes effect.
        """
        frames = self._encode(controlwords, q)
        for sent, (cob_id, data, name) in enumerate(frames):
            try:
                self._master.send(cob_id, data, name)
            except LinkError as error:
                self.partial = self.partial or sent > 0
                done = "" if not sent else f" ({sent} of {len(frames)} out; {self._revert()})"
                raise WriteError(f"{error}{done}") from None
        self._last, self.partial, self.target = frames, False, q.copy()
        self._expires = expires

    def _encode(self, controlwords: Sequence[int], q: Array) -> Frames:
        """Return all frames before any is sent. Raises WriteError."""
        profile = self._profile
        if q.shape != (profile.n,) or not np.isfinite(q).all():
            raise WriteError(f"{self._master.where}: found {q}, expected {profile.n} finite joints")
        frames: Frames = []
        counts = profile.counts(q)
        for joint, node in enumerate(profile.nodes):
            self._image[joint]["Controlword"] = controlwords[joint]
            self._image[joint][profile.target] = int(counts[joint])
            for layout in profile.rpdo:
                try:
                    data = layout.encode(self._image[joint])
                except ValueError as error:
                    raise WriteError(f"{self._master.where}: node {node}: {error}") from None
                frames.append((layout.cob_id(node), data, f"{layout.name} of node {node}"))
        return frames

    def _revert(self) -> str:
        """Replace a set that was sent in part; returns what was done."""
        self.reverted += 1
        if not self._last:
            return "no SYNC will follow"
        try:
            for cob_id, data, name in self._last:
                self._master.send(cob_id, data, name)
        except LinkError:
            return "no SYNC will follow"
        self.partial = False
        return "the set before was sent again"

    def complete_set(self, now: float) -> None:
        """Make sure that a SYNC may be sent at ``now`` (s, monotonic).

        Raises LinkError if a set is still partial.
        """
        if now > self._expires:
            self._expires, self.partial, self._lapsed = math.inf, True, True
            self._last, self.target = self._in_force
        if self.partial:
            done = self._revert()
            if self.partial:
                raise LinkError(
                    f"{self._master.where}: a setpoint is out in part: {done}; the drives stop "
                    "when our heartbeat ends"
                )

    def synced(self) -> None:
        """Note that a SYNC was sent: the last set is in force."""
        self._in_force, self._expires = (self._last, self.target), math.inf
