"""Whole machines in virtual time: scenarios, their stage, the checker, and the command that runs them."""

from coordinator.simulate.run import run_simulation as run_simulation
