"""Solids, a camera and projections for the tests of free space and carving."""

import math

import equinox as eqx
import numpy as np
from on_grid import nodes

import jaxnbv as nbv
from jaxnbv.scanning.sdf import Cuboid, Sphere

# Rays are 0.02 apart on the object, and nodes 0.07.
CAMERA, GRID, POSE = (
    nbv.Camera(height=56, width=70, fov=0.5),
    nbv.Grid(50),
    nbv.look_at((0.8, 0.9, 2.2), target=(0.2, 0.0, 0.0)),
)
CENTRE, RADIUS, HALF = np.array([0.1, -0.2, 0.15]), 0.5, np.array([0.5, 0.3, 0.4])
SOLIDS = {
    "ball": nbv.SDFSurface(Sphere(RADIUS).translate(CENTRE)),
    "box": nbv.SDFSurface(Cuboid(HALF).translate(CENTRE)),
}
SEE = eqx.filter_jit(nbv.Carving.empty_nodes)


def nodes_of(grid):
    axis = np.linspace(-grid.half_extent, grid.half_extent, grid.resolution)
    return nodes(axis)


def in_camera(x, pose):
    return (x - np.asarray(pose.position, np.float64)) @ np.asarray(pose.rotation, np.float64)


def image(x, camera, pose):
    """Depth, and column and row in pixels from the image's corner."""
    right, down, ahead = np.moveaxis(in_camera(x, pose), -1, 0)
    focal = 0.5 * camera.height / math.tan(0.5 * camera.fov)
    with np.errstate(divide="ignore", invalid="ignore"):
        return focal * right / ahead + 0.5 * camera.width, focal * down / ahead + 0.5 * camera.height, ahead
