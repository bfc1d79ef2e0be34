"""Faults on the real wire, and a tap that checks every write: see docs/reliability.md."""
