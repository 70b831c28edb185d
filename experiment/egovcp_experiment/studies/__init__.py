"""Studies of a trained policy: cells of this package, each also ``python -m MODULE``."""
