"""The planner, and the simulated episodes and live sessions that use the planner."""
