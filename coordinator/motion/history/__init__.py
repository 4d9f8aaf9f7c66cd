"""What planned moves do, looked at as a whole (C): corners of the path, filament that passes, heights."""
