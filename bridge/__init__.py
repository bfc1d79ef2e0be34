"""The command line, the cell, the daemon: everything that stands around core and drivers."""
