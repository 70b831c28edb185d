"""Support for tests and benchmarks of egovcp_deploy: a running fake G1, and fault injection.

`fault_kinds.FAULTS` lists the faults, `fault_rig.FaultRig` injects them into a live run against the
fake G1, `fault_runs` evaluates the reactions.
"""
