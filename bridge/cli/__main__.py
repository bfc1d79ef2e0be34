"""``python -m bridge.cli`` is ``gapbridge``."""

from bridge.cli.main import main

main()
