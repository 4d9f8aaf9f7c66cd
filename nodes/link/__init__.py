"""The reliable, ordered byte link to one node, in C, and its I/O thread."""
