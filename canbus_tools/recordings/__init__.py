"""Recordings of CAN buses: candump, pcap, MCAP."""
