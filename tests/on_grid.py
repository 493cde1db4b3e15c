"""Nodes of grids, and balls as sampled surfaces on them."""

import numpy as np

import jaxnbv as nbv


def nodes(axis):
    """Coordinates of all nodes, (g, g, g, 3)."""
    return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)


def balls(grid, radii, centres=None):
    """One ball for each sample, about the origin unless centres are given."""
    centres = np.zeros((len(radii), 3)) if centres is None else centres
    away = [np.linalg.norm(nodes(grid.axis) - centre, axis=-1) for centre in centres]
    return nbv.scanning.GridSurface.from_values(np.stack(away) - np.reshape(radii, (-1, 1, 1, 1)), 0.0, grid)
