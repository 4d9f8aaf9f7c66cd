"""What front ends talk to: methods, the state they watch, the server and its client (docs/ipc.md)."""
