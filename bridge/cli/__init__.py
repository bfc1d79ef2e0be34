"""The command line: ``gapbridge COMMAND``."""

from bridge.cli.main import main

__all__ = ["main"]
