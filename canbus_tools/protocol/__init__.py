"""What travels on the bus: ids, blocks, flow control, and the decoder that names it."""
