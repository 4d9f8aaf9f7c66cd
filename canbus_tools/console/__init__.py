"""The console: parser, session, prompt."""
