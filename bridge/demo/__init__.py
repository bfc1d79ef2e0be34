"""The demo: ``run_demo`` does the whole job on a simulated cell."""

from bridge.demo.job import run_demo

__all__ = ["run_demo"]
