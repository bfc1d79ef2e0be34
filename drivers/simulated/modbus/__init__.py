"""Simulated Modbus controllers: any profile, served from its map, with a plant."""
