"""Ctrl-C, which has to wait where machine code is just being loaded or made."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

WAIT = 0.02  # s until it is looked at again


def heed_interrupts() -> None:
    """Have Ctrl-C end the command, but never inside LLVM; where it is ignored it stays so.

    LLVM calls Python back while it loads a function. An interrupt there is shown as a traceback and
    lost, or what was half loaded crashes the process, which leaves half a file behind.
    """
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, _interrupted)


def _interrupted(number: int, frame: FrameType | None) -> None:
    if not _in_llvm(frame):
        raise KeyboardInterrupt
    again = threading.Timer(WAIT, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _in_llvm(frame: FrameType | None) -> bool:
    while frame is not None:
        if str(frame.f_globals.get("__name__", "")).startswith("llvmlite."):
            return True
        frame = frame.f_back
    return False
