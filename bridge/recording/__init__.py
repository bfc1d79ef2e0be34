"""The recorder: a process of its own that writes what the daemon does into MCAP files."""
