"""Joins a machine service with the ways in: IPC, live page, metrics, discovery, Moonraker's API."""
