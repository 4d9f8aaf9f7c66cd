"""The machine: configuration, pins and states."""
