"""One owner per controller: a lock held during a run, released by the kernel with the process."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
import socket
import sys
from pathlib import Path
from typing import Any, Self

from gapbridge.bridge.cell.runtime_folder import runtime_folder, state_folder
from gapbridge.bridge.document.output_file import sync_folder, write_text
from gapbridge.core.errors import InputError, LinkError, RunError

LONGEST = 65536  # bytes of a note


class OwnerLock:
    """Machine-wide exclusive access to one controller.

    ``before``: the note of the last owner, empty if it ended normally. What is latched is noted
    from the beginning, so that it also outlives an owner that dies at once. A power failure
    empties the folder of the lock, so that there is a mark of a run in the state folder, too;
    ``problem`` says why there is none. As a context manager: an exception leaves note and mark, as
    an end does that ``note_end`` says was not in order. After InputError and LinkError, which
    refuse a run at its start, it is for the next owner as if there had been none.
    """

    def __init__(self, address: str, cell: Path) -> None:
        self.address = address
        self._cell = cell
        self._fd: int | None = None
        self._name: socket.socket | None = None
        self._key = hashlib.sha256(address.encode()).hexdigest()[:16]
        self.before: dict[str, Any] = {}
        self.problem = ""
        self._latched = ""  # as the note has it
        self._in_order = True  # so the run ends: the next owner may arm by itself

    def acquire(self) -> None:
        """Take the lock. Raises InputError if another daemon has it."""
        path = runtime_folder() / f"{self._key}.lock"
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._claim_name()
        except OSError:
            owner = _read(fd)
            os.close(fd)
            who = (
                f"process {owner['pid']}, {owner['cell']}"
                if "pid" in owner
                else ("of another user, or with another runtime folder")
            )
            raise InputError(
                f"{self._cell}: link: {self.address} is in use by another daemon ({who}), "
                "expected one owner per controller"
            ) from None
        self._fd = fd
        self._take_over(os.pread(fd, LONGEST, 0))

    def _take_over(self, text: bytes) -> None:
        """Take the last owner's note, and replace it by one of this owner.

        What was latched is kept until this owner says otherwise.
        """
        self.before = _parsed(text)
        try:
            if self._mark() and not self.before:  # the power failed, or /run was emptied
                self.before = {"cell": str(self._cell)}
        except (InputError, RunError) as error:
            self.problem = str(error)
        self._latched = str(self.before.get("latched", ""))
        self.note({"latched": self._latched} if self._latched else {})

    def _claim_name(self) -> None:
        """Bind a socket name that is visible to all users, whose folders differ."""
        if sys.platform.startswith("linux"):
            self._name = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            try:
                self._name.bind(f"\0gapbridge-{self._key}")
            except OSError:
                self._name.close()
                raise

    def note(self, fields: dict[str, Any]) -> None:
        """Store a note for the next owner, which ``release`` deletes."""
        note = {"pid": os.getpid(), "cell": str(self._cell), **fields}
        self._write(json.dumps(note) + "\n")

    def note_latched(self, latched: str) -> None:
        """Have the note say what is latched; empty: nothing."""
        if latched != self._latched:
            self._latched = latched
            self.note({"latched": latched} if latched else {})

    def note_end(self, in_order: bool) -> None:
        """Note how the run ends; ``in_order``: so that the next owner may arm by itself."""
        self._in_order = in_order

    def _mark(self) -> bool:
        """Mark that a run has begun; returns whether there is a mark already.

        Raises InputError, RunError if it cannot be written.
        """
        path = self._mark_path()
        marked = os.path.lexists(path)
        write_text(path, f"process {os.getpid()}, {self._cell}\n")
        return marked

    def _remove_mark(self) -> None:
        path = self._mark_path()
        path.unlink()
        sync_folder(path.parent)

    def _mark_path(self) -> Path:
        return state_folder() / f"{self._key}.running"

    def _write(self, text: str) -> None:
        if self._fd is not None:
            data = text.encode()
            with contextlib.suppress(OSError):  # a full disk is no reason to stop an arm
                os.pwrite(self._fd, data, 0)
                os.ftruncate(self._fd, len(data))

    @property
    def disorder(self) -> str:
        """Return why the run before may not have ended in order, as text; empty: it has."""
        if self.before:
            pid = self.before.get("pid")
            process = f" (process {pid})" if pid else ""
            return f"the run before{process} did not end in order"
        return f"how the run before ended is not known: {self.problem}" if self.problem else ""

    def release(self) -> None:
        """Release the lock after a normal end."""
        self._write("")
        with contextlib.suppress(OSError, InputError):  # else the next run does not arm by itself
            self._remove_mark()
        self._let_go()

    def _let_go(self) -> None:
        """Release the lock; note and mark stay, as after a crash."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
        if self._name is not None:
            self._name.close()
            self._name = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        refused = kind is not None and issubclass(kind, (InputError, LinkError))
        if not (self._in_order if kind is None else refused):
            self._let_go()
        elif refused and self.before:
            self._write(json.dumps(self.before) + "\n")
            self._let_go()
        else:
            self.release()


def _read(fd: int) -> dict[str, Any]:
    with contextlib.suppress(OSError):
        return _parsed(os.pread(fd, LONGEST, 0))
    return {}


def _parsed(text: bytes) -> dict[str, Any]:
    """Return a note, one line; behind it may be the end of an older one, see ``_write``."""
    with contextlib.suppress(ValueError):
        owner = json.loads(text.split(b"\n")[0])
        if isinstance(owner, dict):
            return owner
    return {}
