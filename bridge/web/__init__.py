"""The status page: a process of its own that shows what the daemon does, and can do nothing."""
