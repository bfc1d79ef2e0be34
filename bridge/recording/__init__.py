"""The recorder: a side process that writes cycles and events into MCAP files."""
