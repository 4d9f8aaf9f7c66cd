"""One reader per kind of section that describes motion: printer, nodes, steppers, rails, extruder, shaper."""
