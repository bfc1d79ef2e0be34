"""The demo: ``run_demo`` does the whole job on a simulated cell."""

from gapbridge.bridge.demo.job import run_demo

__all__ = ["run_demo"]
