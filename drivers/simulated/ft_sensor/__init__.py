"""Simulated force-torque sensors on their real wires, with the plant behind them."""
