"""Small helpers of all rooms of nodes: errors, option values, files with secrets, the C wire codec."""
