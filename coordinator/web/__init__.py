"""The live page: a thin server in front of coordinator.ipc, and the page itself."""
