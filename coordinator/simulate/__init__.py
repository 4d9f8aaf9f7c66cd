"""Whole machines in virtual time: scenarios, their stage, the checker and the command that runs them."""
