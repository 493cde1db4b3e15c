"""The study of a recorded sequence: which of its frames show a place in the fewest views."""
