"""Computes the surface of a posterior's mean: triangles with a standard deviation at each vertex."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.farthest_points import farthest_point_indices
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.scanning import Grid
from jaxnbv.scanning.mesh import level_triangles

# Variance and slope are computed at this many vertices and interpolated to the others. The variance of a point costs a
# triangular solve with the whole cloud. The slope costs two evaluations of the mean.
_DEVIATION_ANCHORS = 256
_SLOPE_ANCHORS = 1024
_SLOPE_STEP = 0.005
# Deviation that `near_points` adds, as a fraction of the distance r to the nearest point. On a cow after one to five
# views, at r = 0.1 to 0.4 scene units, the surface's root mean square error is 0.2 r to 0.3 r, two to three times the
# posterior's standard deviation. Measured from the truth to the surface, which may lack a part of the object, the error
# is 0.4 r to 0.7 r.
_DEVIATION_PER_DISTANCE = 0.25
# A piece of the surface is kept if a point of the cloud is nearer than this, in scene units.
_MAX_DISTANCE = 0.1


class MeanSurface(eqx.Module):
    """Triangles of the surface where the posterior mean equals its level, in scene coordinates.

    - `normals`: outward unit normal at each vertex.
    - `deviation`: standard deviation of the surface's position along its normal, in scene units. To first order, this
      is sd f(x) / |grad E f(x)|, where f is the posterior's function.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]
    normals: Float[np.ndarray, "v 3"]
    deviation: Float[np.ndarray, " v"]

    @property
    def mesh(self) -> trimesh.Trimesh:
        """The triangles without normals and deviation."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)

    def part(self, is_kept: Bool[np.ndarray, " v"]) -> "MeanSurface | None":
        """Return the pieces whose vertices are marked in `is_kept`; None if no face is left.

        - `is_kept`: mask of the vertices, with the same value for all vertices of a connected piece.
        """
        faces = self.faces[is_kept[self.faces[:, 0]]]
        if len(faces) == 0:
            return None
        rows = self.vertices[is_kept], (np.cumsum(is_kept) - 1)[faces], self.normals[is_kept], self.deviation[is_kept]
        return MeanSurface(*rows)


def mean_surface(sampler: SurfaceSampler, inputs: StepInputs) -> MeanSurface | None:
    """Return the surface where the carved posterior mean equals its level; None if there is none.

    If the posterior in `inputs` has no closed forms, mean and deviation are computed from the samples in `inputs` or,
    if there are none, from new samples with a fixed key.
    """
    observations, posterior, surfaces = inputs.observations, inputs.posterior, inputs.surfaces
    assert posterior is not None
    if not posterior.has_closed_forms:
        surfaces = sampler.sample(observations, jax.random.key(0), posterior) if surfaces is None else surfaces
        return _mean_of_samples(np.asarray(surfaces.values, np.float64), sampler.grid)
    triangles = level_triangles(np.array(sampler.mean(observations, posterior)), sampler.grid)
    if triangles is None:
        return None
    vertices, faces, normals = triangles
    # Add normals to the positions, so that the two sides of a thin sheet are far apart.
    features = np.concatenate([vertices, 0.1 * normals], axis=1)
    anchors = _farthest_rows(features, _SLOPE_ANCHORS)
    deviation_rows = anchors[:_DEVIATION_ANCHORS]
    dtype = observations.cloud.points.dtype
    variance = np.asarray(posterior.variance(vertices[deviation_rows].astype(dtype)))
    step = _SLOPE_STEP * normals[anchors]
    ahead, behind = (np.asarray(posterior.mean((vertices[anchors] + s).astype(dtype))) for s in (step, -step))
    slope = np.abs(ahead - behind) / (2.0 * _SLOPE_STEP)
    value_deviation = _interpolate(features, deviation_rows, np.sqrt(np.maximum(variance, 1e-30)))
    deviation = value_deviation / _interpolate(features, anchors, np.maximum(slope, 1e-6))
    return MeanSurface(vertices, faces, normals, deviation)


def _mean_of_samples(values: Float[np.ndarray, "s g g g"], grid: Grid) -> MeanSurface | None:
    mean = values.mean(axis=0)
    triangles = level_triangles(mean, grid)
    if triangles is None:
        return None
    vertices, faces, normals = triangles
    grid_points = (vertices + grid.half_extent).T / grid.spacing
    gradient = [map_coordinates(part, grid_points, order=1) for part in np.gradient(mean, grid.spacing)]
    slope = np.linalg.norm(gradient, axis=0)
    value_deviation = map_coordinates(values.std(axis=0, ddof=min(1, len(values) - 1)), grid_points, order=1)
    return MeanSurface(vertices, faces, normals, value_deviation / np.maximum(slope, 1e-6))


def near_points(surface: MeanSurface | None, cloud: PointCloud) -> MeanSurface | None:
    """Return the connected pieces of a surface that are near points of the cloud; None if there are none.

    The deviation becomes sqrt(sd^2 + (r / 4)^2), where sd is the surface's deviation and r the distance to the nearest
    point of the cloud. Without the second term, it would be too small where no ray has hit.
    """
    if surface is None:
        return None
    distances, _ = cKDTree(cloud.to_numpy()[0]).query(surface.vertices)
    edges = np.concatenate([surface.faces[:, :2], surface.faces[:, 1:]])
    piece = trimesh.graph.connected_component_labels(edges, len(surface.vertices))
    deviation = np.hypot(surface.deviation, _DEVIATION_PER_DISTANCE * distances)
    is_kept = np.isin(piece, piece[distances < _MAX_DISTANCE])
    return dataclasses.replace(surface, deviation=deviation).part(is_kept)


def padded(rows: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "m d"]:
    """Add zero rows up to a power of two, so that surfaces of different sizes share a compiled program."""
    return np.pad(rows, ((0, (1 << (len(rows) - 1).bit_length()) - len(rows)), (0, 0)))


def _farthest_rows(features: Float[np.ndarray, "n d"], count: int) -> Int[np.ndarray, " count"]:
    """Return indices of `count` rows by farthest point sampling, in the order in which they are chosen.

    If there are too few rows, the first is repeated.
    """
    rows = jnp.asarray(padded(features.astype(np.float32)))
    return np.asarray(farthest_point_indices(rows, jnp.arange(len(rows)) < len(features), count))


def _interpolate(features: np.ndarray, anchors: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate positive values from some rows of `features` to all, as weighted means of logarithms.

    - `anchors`, `values`: indices of rows, and the values there.
    """
    distance, neighbours = cKDTree(features[anchors]).query(features, k=min(8, len(anchors)))
    width = 0.5 * distance[:, -1:] + 1e-12
    weight = np.exp(-0.5 * (distance / width) ** 2) + 1e-12
    return np.exp(np.sum(weight * np.log(values)[neighbours], axis=1) / np.sum(weight, axis=1))
