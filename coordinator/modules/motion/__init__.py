"""Commands that move: force move, firmware retraction, arcs."""
