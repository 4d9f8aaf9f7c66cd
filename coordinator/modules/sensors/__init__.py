"""Temperature sensors, filament sensors and buttons."""
