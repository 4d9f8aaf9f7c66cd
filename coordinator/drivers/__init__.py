"""What data sheets say about stepper drivers with registers: pure tables and formulas, no I/O."""
