"""The on-cell daemon: the loop's process, its control socket, its settings."""
