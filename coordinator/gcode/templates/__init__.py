"""G-code templates of macros, rendered in a sandbox with limits."""
