"""Injects faults into a live run against the fake G1, over the real wire.

`kinds.FAULTS` lists the faults, `rig.FaultRig` runs them, `table` sums up the reactions. For tests
and for ``benchmarks/live_faults.py``.
"""
