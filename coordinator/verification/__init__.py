"""The oracles: independent evaluation of a plan, shared by demo, simulation and tests. Nothing of the engine."""
