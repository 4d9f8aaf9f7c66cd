"""A machine that prints for a quarter of an hour while clients come and go, and what it needs meanwhile."""
