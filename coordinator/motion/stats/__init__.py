"""What a plan asks of machine and buses over time (C)."""
