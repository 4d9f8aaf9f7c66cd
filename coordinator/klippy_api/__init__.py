"""The host API that Moonraker speaks, served from the machine service (docs/klippy-api.md)."""
