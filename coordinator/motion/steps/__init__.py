"""Step generation and compression (C) with their Python face: from trapezoids to commands of nodes.

In C: ``times/`` finds when each stepper's steps are due, ``compression/`` makes segments of them; here they
become the commands of each node.
"""
