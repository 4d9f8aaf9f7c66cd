"""The machine as a whole: configuration, time base, motion, G-code and the command line."""
