"""G28: the plan of rails and endstops, homing override, safe Z home."""
