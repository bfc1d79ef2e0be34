"""The CAN bus as all drivers on it see it."""
