"""The command ``canductor``: entry point, parser, arguments and commands."""
