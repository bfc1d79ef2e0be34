"""Listeners informed of each function that is compiled for this machine: once per installation.

Apart from ``machine_code``, so that nobody imports numba only to be informed.
"""

from __future__ import annotations

from collections.abc import Callable

ABOUT = "compiling for this machine, once"
listeners: list[Callable[[int], None]] = []
"""Called with how many functions this process has begun to compile, from 1; none that is loaded."""
_begun = 0


def begin() -> None:
    """Inform the listeners of one more function."""
    global _begun
    _begun += 1
    for listener in listeners:
        listener(_begun)
