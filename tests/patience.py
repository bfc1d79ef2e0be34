"""How long a test waits for what must come: long, for a busy machine says nothing about it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

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
