"""The oracles: independent evaluation of a plan for demo, simulation and tests; no code of the engine."""
