"""Ask where to look next, tell what was seen: the planner, and the episodes and sessions that call it."""
