"""Moves outside a program's stream: a single move, a straight move of the head, a homing move."""
