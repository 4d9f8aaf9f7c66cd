"""Step generation and compression (C) with their Python face: from trapezoids to commands of nodes."""
