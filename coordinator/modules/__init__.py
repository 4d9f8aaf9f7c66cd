"""Modules: everything but motion, such as heaters, fans and macros. base.py is their interface."""
