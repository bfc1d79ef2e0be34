"""Frame-mapped CAN arms: the map is data, a DBC and a YAML profile."""
