"""The command line: ``gapbridge COMMAND``."""

from gapbridge.bridge.cli.main import main

__all__ = ["main"]
