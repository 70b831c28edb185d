"""Training and evaluation of the low-level controller (``egovcp-train-lowlevel``)."""
