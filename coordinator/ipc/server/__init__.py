"""The server: sockets, sessions, state tree, uploads, authentication."""
