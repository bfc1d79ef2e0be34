"""``gapbridge``, and ``python -m gapbridge`` where its script is not on the path."""

import os
import signal


def run() -> None:
    """Run the command. An interrupt while it is imported is one line, too: nothing is open yet."""
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if ours:
        signal.signal(signal.SIGINT, _leave)
    from gapbridge.bridge.cli import main

    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()


def _leave(*_: object) -> None:
    os.write(2, b"error: interrupted\n")
    os._exit(1)


if __name__ == "__main__":
    run()
