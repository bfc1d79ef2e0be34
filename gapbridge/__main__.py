"""Entry point of ``gapbridge`` and of ``python -m gapbridge``."""

import os
import signal


def run() -> None:
    """Run the command. An interrupt during the imports ends with one line: nothing is open yet."""
    default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if default:
        signal.signal(signal.SIGINT, _leave)
    from gapbridge.bridge.cli import main

    if default:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    main()


def _leave(*_: object) -> None:
    os.write(2, b"error: interrupted\n")
    os._exit(128 + signal.SIGINT)


if __name__ == "__main__":
    run()
