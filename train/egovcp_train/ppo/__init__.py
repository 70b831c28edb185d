"""The model-free baseline: PPO on the observation and the actions of the planner."""
