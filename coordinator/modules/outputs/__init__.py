"""Output pins."""
