"""What macros and front ends see of the machine."""
