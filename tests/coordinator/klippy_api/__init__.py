"""The host API that Moonraker speaks."""
