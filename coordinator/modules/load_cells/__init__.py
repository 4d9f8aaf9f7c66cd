"""Scales, and the nozzle as a probe by its force: load cells on HX711 and HX717."""
