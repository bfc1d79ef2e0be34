"""What a run opens before its first loop and closes after its last: locks, sockets, processes."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING

from gapbridge.bridge.cell.runtime_folder import cell_key, runtime_folder
from gapbridge.bridge.daemon.host import OwnerLock
from gapbridge.bridge.document.output_file import private
from gapbridge.bridge.ipc.control_socket import ControlSocket
from gapbridge.bridge.recording.folder import LOOP_LOG, new_session, require_folder
from gapbridge.core.errors import InputError
from gapbridge.drivers.controller_address import address_of

if TYPE_CHECKING:
    from gapbridge.bridge.daemon.daemon import Daemon


def open_all(daemon: Daemon, stack: ExitStack, arm: bool, by: str) -> bool:
    """Open everything; ``stack`` closes it. Returns whether the first loop may arm by itself.

    Raises InputError where the controller has an owner already, or a folder cannot be used.
    """
    settings = daemon.settings
    stack.callback(daemon.close_memory)
    lock = OwnerLock(address_of(settings.link), settings.cell)
    stack.enter_context(lock)
    folder = settings.recording.folder
    if folder is not None:
        require_folder(folder)
    daemon.session = new_session(folder)
    if folder is not None:
        log = folder / f"{daemon.session}{LOOP_LOG}"
        daemon.output = stack.enter_context(open(log, "ab", opener=private))  # noqa: SIM115
    order = {
        "settings": settings.model_dump(mode="json"), "n": daemon.configuration.n,
        "session": daemon.session, "extra": {"text": daemon.configuration.text},
    }  # fmt: skip
    stack.callback(daemon.sides.close)
    daemon.sides.start(settings, order, daemon.page, daemon.output)
    stack.callback(lambda: daemon.book.add({"kind": "ended"}))
    _open_socket(daemon, stack)
    if settings.web is not None:
        daemon.book.add({"kind": "note", "detail": f"status page: {settings.web.url}"})
    if settings.setpoints.source == "planner":
        where = f"setpoints: a planner writes to {settings.setpoints.socket}"
        daemon.book.add({"kind": "note", "detail": where})
    # a person at the terminal may arm after a crash; a service that was started anew may not
    if arm and lock.before and (by != "--arm" or daemon.manager.present):
        daemon.book.add(
            {
                "kind": "refused",
                "detail": f"the run before (process {lock.before.get('pid')}) did not end in "
                "order: not arming by itself; gapbridge arm",
            }
        )
        return False
    return arm


def _open_socket(daemon: Daemon, stack: ExitStack) -> None:
    path = runtime_folder() / f"{cell_key(daemon.settings.cell)}.sock"
    daemon.socket = ControlSocket(path, daemon.control.answer)
    try:
        stack.enter_context(daemon.socket)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}, expected a socket to listen on") from None
