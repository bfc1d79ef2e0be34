"""A disk that loses what was not synced: what a power cut leaves, at its worst and as drawn.

At its worst a cut leaves what was synced and nothing else (``cut``). Where a seed is given, cuts
are drawn too, behind every line of the product that has changed or synced anything: each file then
holds what was synced or any beginning of what was written since, and each name that was made,
renamed or removed since its folder was synced may or may not have been.
"""

from __future__ import annotations

import os
import random
import shutil
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

Place = tuple[str, int]  # file and line that asked for a sync
Node = tuple[int, int]  # device and inode
Names = dict[str, Node]
ROOT = str(Path(__file__).parents[1])
PRODUCT = tuple(f"{ROOT}/gapbridge/{layer}/" for layer in ("bridge", "core"))
DRAWN = 3  # cuts at one point, beside the two that keep nothing and everything


class LosingDisk:
    """Watches the files below a folder while the ``with`` block lasts.

    Contents are kept as they were at the file's last sync, names as they were at their folder's.
    ``dropped``: a place in the product whose syncs do nothing. ``seed``: cuts are drawn as well,
    and what each leaves is given to the check that ``expect`` was called with last.
    """

    def __init__(self, folder: Path, dropped: Place | None = None, seed: int | None = None) -> None:
        self._folder, self._dropped = folder, dropped
        self._random = None if seed is None else random.Random(seed)
        self.places: list[Place] = []  # that have asked for a sync, once each
        self.failures: list[str] = []  # of checks of what a drawn cut left
        self.drawn = 0
        self._check: Callable[[Path], None] = lambda left: None
        self._pins: dict[Node, int] = {}  # open, so that no other file gets a node's number
        self._folders: set[Node] = set()
        self._contents: dict[Node, bytes] = {}  # synced
        self._least: dict[Node, int] = {}  # shortest length since
        self._names: dict[Node, Names] = {}  # synced
        self._since: dict[Node, dict[str, set[Node | None]]] = {}  # what names stood for since
        self._seen: object = None
        self._root = _node(os.stat(folder))
        self._look()
        for node in self._pins:  # what is there from before is on the disk
            self._keep(node)

    def __enter__(self) -> Self:
        self._real = (os.fsync, os.fdatasync)
        os.fsync = os.fdatasync = self._sync  # type: ignore[assignment]
        if self._random is not None:
            self._traced = sys.gettrace()
            sys.settrace(self._on_call)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        os.fsync, os.fdatasync = self._real
        if self._random is not None:
            sys.settrace(self._traced)
        for fd in self._pins.values():
            os.close(fd)

    # -- what is there, and what was synced ------------------------------------------------------

    def _look(self) -> bool:
        """Note what is there now; return whether anything has changed."""
        found = list(_entries(self._folder))
        if found == self._seen:
            return False
        self._seen = found
        now: dict[Node, Names] = {}
        for path, node, size, is_folder in found:
            if node not in self._pins:
                self._pins[node] = os.open(path, os.O_RDONLY)
                self._contents[node], self._names[node], self._since[node] = b"", {}, {}
                self._least[node] = 0  # of it nothing may be left
            if is_folder:
                self._folders.add(node)
                now[node] = {}
            if path != self._folder:
                now[_node(os.stat(path.parent))][path.name] = node
            self._least[node] = min(self._least[node], size)
        for folder, names in now.items():
            since = self._since[folder]
            for name in {*self._names[folder], *names, *since}:
                since.setdefault(name, set()).add(names.get(name))
        return True

    def _keep(self, node: Node) -> None:
        """Have what is in a file, or which names are in a folder, on the disk."""
        if node in self._folders:
            self._names[node] = self._names_in(node)
            self._since[node] = {name: {kept} for name, kept in self._names[node].items()}
        else:
            self._contents[node] = self._content(node)
            self._least[node] = len(self._contents[node])

    def _names_in(self, folder: Node) -> Names:
        with os.scandir(self._pins[folder]) as entries:
            return {e.name: _node(e.stat(follow_symlinks=False)) for e in entries}

    def _content(self, node: Node) -> bytes:
        return Path(f"/proc/self/fd/{self._pins[node]}").read_bytes()

    def _sync(self, fd: int) -> None:
        place = _place()
        if place[0].startswith("gapbridge/") and place not in self.places:
            self.places.append(place)
        if place == self._dropped:
            return
        self._draw_if(self._look())
        if (node := _node(os.fstat(fd))) in self._pins:
            self._keep(node)
            self._draw_if(True)

    # -- cuts -------------------------------------------------------------------------------------

    def cut(self, into: Path) -> Path:
        """Write what is left at worst after a power cut now; returns that folder."""
        self._look()
        self._restore(self._root, into, self._names.__getitem__, self._contents.__getitem__)
        return into

    def lose(self, draw: random.Random) -> None:
        """Have the folder hold what a power cut now leaves: at worst, or as drawn."""
        self._look()
        into = self._folder.with_name(f"{self._folder.name}-left")
        self._leave(into, 0 if draw.random() < 0.5 else 2, draw)
        for path in self._folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in into.iterdir():
            path.rename(self._folder / path.name)
        into.rmdir()
        self._look()
        for node in (self._root, *self._names_in(self._root).values()):
            self._keep(node)

    def expect(self, check: Callable[[Path], None]) -> None:
        """Judge what drawn cuts leave by this from now on; a check raises for what must not be."""
        self._draw_if(self._look())
        self._check = check
        self._draw_if(True)

    def _on_call(self, frame: FrameType, event: str, arg: object) -> Any:
        return self._on_line if frame.f_code.co_filename.startswith(PRODUCT) else None

    def _on_line(self, frame: FrameType, event: str, arg: object) -> Any:
        self._draw_if(self._look())
        return self._on_line

    def _draw_if(self, changed: bool) -> None:
        if not changed or self._random is None or self.failures:
            return
        tracing = sys.gettrace()
        sys.settrace(None)  # readers are the product's too
        syncs = os.fsync, os.fdatasync
        os.fsync, os.fdatasync = self._real
        try:
            for number in range(2 + DRAWN):
                self._judge_one(number)
        finally:
            os.fsync, os.fdatasync = syncs
            sys.settrace(tracing)

    def _judge_one(self, number: int) -> None:
        """Judge one cut: of 0 only what was synced is left, of 1 everything, else as drawn."""
        assert self._random is not None
        into = self._folder.with_name(f"{self._folder.name}-{self.drawn}")
        self.drawn += 1
        self._leave(into, number, self._random)
        try:
            self._check(into)
        except Exception:
            left = [str(path.relative_to(into)) for path in sorted(into.rglob("*"))]
            self.failures.append(f"cut {self.drawn}, which left {left}:\n{traceback.format_exc()}")
        shutil.rmtree(into)

    def _leave(self, into: Path, number: int, draw: random.Random) -> None:
        """Write what cut ``number`` leaves, see ``_judge_one``."""

        def names(folder: Node) -> Names:
            synced, now = self._names[folder], self._names_in(folder)
            if number < 2:
                return now if number else synced
            found = {
                name: draw.choice(sorted({*stood, synced.get(name)}, key=str))
                for name, stood in sorted(self._since[folder].items())
            }
            return {name: node for name, node in found.items() if node is not None}

        def content(node: Node) -> bytes:
            synced, now = self._contents[node], self._content(node)
            if number < 2:
                return now if number else synced
            if draw.random() < 0.2:
                return synced
            return now[: draw.randint(min(self._least[node], len(now)), len(now))]

        self._restore(self._root, into, names, content)

    def _restore(
        self, folder: Node, into: Path,
        names: Callable[[Node], Names], content: Callable[[Node], bytes],
    ) -> None:  # fmt: skip
        into.mkdir()
        for name, node in names(folder).items():
            if node in self._folders:
                self._restore(node, into / name, names, content)
            else:
                (into / name).write_bytes(content(node))


def _entries(folder: Path) -> Any:
    """Yield path, node, size and kind of a folder and of all below it, and when each changed."""
    found = os.stat(folder)
    yield folder, _node(found), 0, True
    for entry in sorted(os.scandir(folder), key=lambda e: e.name):
        path = Path(entry.path)
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(path)
        else:
            found = entry.stat(follow_symlinks=False)
            yield path, _node(found), found.st_size, False


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
