"""Progress on stderr, if it is a terminal."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable, Iterator

from gapbridge.core.kernels.compiling import ABOUT

REPORT_PERIOD = 10.0  # s between two lines on compiling


@contextlib.contextmanager
def progress(label: str, total: int | None = None) -> Iterator[Callable[[int], None]]:
    """Yield a function that advances a progress bar; it does nothing without a terminal."""
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
    """Yield a function that shows the current step; it does nothing without a terminal."""
    if not sys.stderr.isatty():
        yield lambda text: None
        return
    from rich.console import Console
    from rich.text import Text  # plain: ":wrench:" would become an emoji

    with Console(stderr=True).status(label) as spinner:
        yield lambda text: spinner.update(Text(f"{label}: {text}"))


class CompileProgress:
    """Reports on stderr that functions are compiled, at once and every REPORT_PERIOD."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._start: float | None = None  # s
        self._next = 0.0  # s: time of the next line

    def __call__(self, functions: int) -> None:
        """Report the number of functions whose compilation has started."""
        now = self._clock()
        if self._start is None:
            self._start = now
            sys.stderr.write(f"{ABOUT}: it takes a minute or two\n")
        elif now >= self._next:
            sys.stderr.write(f"  {functions} functions, {now - self._start:.0f} s\n")
        else:
            return
        self._next = now + REPORT_PERIOD
