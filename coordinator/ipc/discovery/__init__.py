"""Announcing a machine on the network and finding machines (DNS-SD)."""
