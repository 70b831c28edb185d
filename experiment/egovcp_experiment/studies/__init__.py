"""Studies of a trained policy; each runs as a cell of an experiment, or as ``python -m MODULE``."""
