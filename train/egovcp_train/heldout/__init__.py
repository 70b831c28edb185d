"""Measurements of a world model on held-out episodes."""
