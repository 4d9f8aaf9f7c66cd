"""Ways to reach nodes: SocketCAN, the virtual bus, any python-can backend, UART."""
