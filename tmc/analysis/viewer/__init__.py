"""Replay files for viewers: `overfly log replay`."""
