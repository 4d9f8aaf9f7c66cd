"""Generic mutation: every operator, comparison, literal, condition and early return, and who notices.

``run.py`` is the program; ``areas.py`` says which files are mutated, ``equivalent.toml`` explains survivors.
"""
