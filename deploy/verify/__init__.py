"""Verifies missions: exactness, asynchrony, and chaos."""
