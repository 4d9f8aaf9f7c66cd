"""Small helpers without knowledge of the machine: atomic files, interrupts, progress, command options."""
