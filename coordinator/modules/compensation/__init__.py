"""Corrections of positions while the machine moves: mesh, tilt, twist, skew, heat."""
