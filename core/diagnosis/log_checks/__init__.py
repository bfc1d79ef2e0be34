"""Checks of a log that come before any effect: units, clocks, frames and signs."""
