"""Supervision between planner and robot: state machine, watchdogs, late plans, command limits."""
