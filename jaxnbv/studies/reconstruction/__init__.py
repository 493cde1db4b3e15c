"""Reconstruction of the surface: the table of the paper's supplement."""
