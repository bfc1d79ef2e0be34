"""How long a test waits for what must come: long, for a busy machine says nothing about it."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import Any

from gapbridge.core.errors import RunError

PATIENCE = 120.0  # s


def wait_for(
    what: Callable[[], Any], words: str | Callable[[], str], within: float = PATIENCE
) -> Any:
    """Wait until ``what`` returns something true, and return it; ``words`` say what was missed.

    ``within`` (s) is for tests whose subject is time, which are marked ``realtime``.
    """
    begun = time.monotonic()
    while not (found := what()):
        late = time.monotonic() - begun >= within
        assert not late, f"{words() if callable(words) else words}: not within {within:g} s"
        time.sleep(0.01)
    return found


def wait_for_error(read: Callable[[], object], kind: type[RunError], words: str) -> str:
    """Read until an error of a kind says ``words`` (a regular expression), and return its text.

    Others may come before: a busy machine makes states late and tears them.
    """
    others = set[str]()

    def said() -> str:
        try:
            read()
        except RunError as error:
            if isinstance(error, kind) and re.search(words, str(error)):
                return str(error)
            others.add(str(error))
        return ""

    return str(wait_for(said, lambda: f"{words} ({others or 'no error'})"))
