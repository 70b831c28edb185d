"""Cells that compute with the library alone; each is a command, ``python -m``, of its own."""
