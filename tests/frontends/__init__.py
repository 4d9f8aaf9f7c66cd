"""Real front ends on virtual hardware: `make frontends`, apart from `make test`."""
