"""The status page: a side process that shows what the daemon does, read-only."""
