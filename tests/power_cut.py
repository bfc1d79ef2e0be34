"""A disk that keeps what was synced and nothing else: what a power cut leaves, at its worst."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import TracebackType
from typing import Self

Place = tuple[str, int]  # file and line that asked for a sync
Node = tuple[int, int]  # device and inode
ROOT = str(Path(__file__).parents[1])


class LosingDisk:
    """Watches the syncs below a folder while the ``with`` block lasts.

    Contents are kept as they were at the file's last sync, names as they were at their folder's.
    ``dropped``: a place in the product whose syncs do nothing.
    """

    def __init__(self, folder: Path, dropped: Place | None = None) -> None:
        self._folder, self._dropped = folder, dropped
        self.places: list[Place] = []  # that have asked for a sync, once each
        self._contents: dict[Node, bytes] = {}
        self._names: dict[Node, dict[str, Node]] = {}
        self._keep(folder)  # what is there from before is on the disk

    def _keep(self, path: Path) -> None:
        node = _node(os.stat(path))
        if path.is_dir():
            self._names[node] = {p.name: _node(p.stat()) for p in path.iterdir()}
            for inner in path.iterdir():
                self._keep(inner)
        else:
            self._contents[node] = path.read_bytes()

    def __enter__(self) -> Self:
        self._real = (os.fsync, os.fdatasync)
        os.fsync = os.fdatasync = self._sync  # type: ignore[assignment]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        os.fsync, os.fdatasync = self._real

    def _sync(self, fd: int) -> None:
        place = _place()
        if place[0].startswith("gapbridge/") and place not in self.places:
            self.places.append(place)
        if place == self._dropped:
            return
        found = os.fstat(fd)
        path = Path(os.readlink(f"/proc/self/fd/{fd}"))
        if path.is_dir():
            self._names[_node(found)] = {p.name: _node(p.stat()) for p in path.iterdir()}
        else:
            self._contents[_node(found)] = path.read_bytes()

    def cut(self, into: Path) -> Path:
        """Write what is left after a power cut now; returns that folder."""
        into.mkdir()
        self._restore(_node(os.stat(self._folder)), into)
        return into

    def _restore(self, folder: Node, into: Path) -> None:
        for name, node in self._names.get(folder, {}).items():
            if node in self._names or (node not in self._contents and _is_folder(node, self)):
                (into / name).mkdir()
                self._restore(node, into / name)
            else:
                (into / name).write_bytes(self._contents.get(node, b""))


def _is_folder(node: Node, disk: LosingDisk) -> bool:
    """Return whether a node is a folder whose own names were never synced."""
    return any(path.is_dir() and _node(path.stat()) == node for path in disk._folder.rglob("*"))


def _node(found: os.stat_result) -> Node:
    return found.st_dev, found.st_ino


def _place() -> Place:
    """Return who has asked: the innermost frames of the product, to its outermost caller.

    A function that only syncs is distinguished by who calls it.
    """
    frame = sys._getframe(2)
    if frame.f_code.co_name == "sync_folder" and frame.f_back is not None:
        frame = frame.f_back
    name = frame.f_code.co_filename.removeprefix(ROOT).lstrip("/")
    return name, frame.f_lineno
