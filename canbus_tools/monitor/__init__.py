"""What the live monitor knows and shows."""
