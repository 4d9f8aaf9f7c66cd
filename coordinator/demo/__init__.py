"""The demo: the whole machine on virtual nodes, and the proof that it did what was planned."""

from coordinator.demo.run import run_demo as run_demo
