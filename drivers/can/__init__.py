"""Frame-mapped CAN arms: the map is data, a DBC and a small YAML beside it."""
