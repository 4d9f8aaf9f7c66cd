"""G-code programs: parser, interpreter, commands, and the events that drive the machine."""
