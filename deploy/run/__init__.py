"""Runs a mission: its processes with their supervisor, or lock step in one process."""
