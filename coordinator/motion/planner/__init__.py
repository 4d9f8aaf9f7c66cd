"""G-code hot path and look-ahead (C) with their Python face: from lines to trapezoids."""
