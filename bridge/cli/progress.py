"""Progress on stderr, when a person looks on."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from gapbridge.core.kernels.compiling import ABOUT
from gapbridge.drivers.clock import SYSTEM

AGAIN = 10.0  # s between two words on compiling


@contextlib.contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Give a function that advances a bar; silent where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield lambda count: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bars:
        task = bars.add_task(label, total=total)
        yield lambda count: bars.advance(task, count)


@contextlib.contextmanager
def status(label: str) -> Iterator[Callable[[str], None]]:
    """Give a function that reports what is being done; silent where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.text import Text  # as it stands: ":wrench:" is no picture here

    with Console(stderr=True).status(label) as shown:
        yield lambda text: shown.update(Text(f"{label}: {text}"))


class Compiling:
    """Says on stderr that functions are compiled, at once and then now and again."""

    def __init__(self, clock: Callable[[], float] = SYSTEM.monotonic) -> None:
        self._clock = clock
        self._begun: float | None = None  # s
        self._next = 0.0  # s: when it says so again

    def __call__(self, functions: int) -> None:
        """Take note that so many functions have begun."""
        now = self._clock()
        if self._begun is None:
            self._begun = now
            sys.stderr.write(f"{ABOUT}: it takes a minute or two\n")
        elif now >= self._next:
            sys.stderr.write(f"  {functions} functions, {now - self._begun:.0f} s\n")
        else:
            return
        self._next = now + AGAIN
