"""Robots that the runner can drive, one module per robot; `base` defines the interfaces."""
