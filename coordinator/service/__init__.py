"""The machine as a service: one owner of its life, driven and watched by clients."""
