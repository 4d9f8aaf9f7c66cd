"""``canductor plan``: what a program asks of machine and buses, its figures, warnings and plot."""
