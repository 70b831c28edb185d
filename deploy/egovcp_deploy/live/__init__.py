"""A robot on the wall clock: the 50 Hz control loop, the planner, and the link between them."""
