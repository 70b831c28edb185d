"""A simulated G1 behind the protocol of LeRobot's bridge."""
