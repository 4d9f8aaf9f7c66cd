"""The demo: the whole machine on virtual nodes, and the proof that it did what was planned."""
