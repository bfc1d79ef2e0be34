"""Simulated Modbus controllers: any profile served from its own map, a plant behind it."""
