"""Poses, cameras, clouds, and the frame that they are in."""
