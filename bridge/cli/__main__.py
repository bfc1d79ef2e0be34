"""``python -m gapbridge.bridge.cli`` is ``gapbridge`` too."""

from gapbridge.bridge.cli.main import main

main()
