"""A bell for canductor: an example of a module in a package of its own."""
