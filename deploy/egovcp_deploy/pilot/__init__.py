"""Between the planner and the robot: states, watchdogs, late plans, and what may be sent."""
