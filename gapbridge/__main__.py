"""``python -m gapbridge``: the command, where its script is not on the path."""

from gapbridge.bridge.cli import main

main()
