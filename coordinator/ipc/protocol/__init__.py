"""Messages and methods of the IPC; sans-IO."""
