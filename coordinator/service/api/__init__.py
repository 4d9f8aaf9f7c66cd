"""The methods that front ends call, by subject."""
