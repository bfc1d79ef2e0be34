"""The demo: ``run_demo`` calibrates, compensates and diagnoses a simulated cell."""

from gapbridge.bridge.demo.job import run_demo

__all__ = ["run_demo"]
