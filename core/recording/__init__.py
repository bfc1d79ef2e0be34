"""Recordings: MCAP files of a daemon's cycles and events, how they are laid out and read.

Written by ``bridge.recording``; read by the export, by the replaying driver, and by any program
that knows MCAP and protobuf (Foxglove among them).
"""
