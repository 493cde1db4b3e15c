"""Screened Poisson surface reconstruction of a cloud, for comparison with the posterior mean."""

import numpy as np

from jaxnbv.checks import InputError, checked, require
from jaxnbv.errors import install
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.frame import Frame
from jaxnbv.scanning.mesh import TriangleMesh


def has_poisson() -> bool:
    """Return whether `screened_poisson` can run, that is, whether `pymeshlab` can be imported."""
    try:
        import pymeshlab  # noqa: F401
    except ImportError:
        return False
    return True


@checked
def screened_poisson(cloud: PointCloud, depth: int = 8) -> TriangleMesh:
    """Reconstruct a surface from an oriented cloud by the screened Poisson method.

    MeshLab computes the surface by the method of Kazhdan and Hoppe (2013). The mesh is in scene coordinates, its faces
    are wound outward, and every run gives the same mesh. It bridges gaps in the scan, and is open where the surface
    leaves a cube of 1.1 times the cloud's size.

    - `depth`: depth of the octree. For dense points, the smallest details have 1 / 2^depth of the cloud's size.

    **Raises:** `ValueError` if `pymeshlab`, an optional dependency (GPL), is not installed, if the depth is not within
    [1, 12], if the cloud has fewer than four points or an entry that is not finite, or if there is no surface.
    """
    require(1 <= depth <= 12, f"the octree's depth is {depth}; it must be at least 1 and at most 12, such as 8")
    try:
        import pymeshlab
    except ImportError as error:
        raise InputError(
            f"Poisson reconstruction needs pymeshlab, which cannot be imported ({error}): "
            f"{install('poisson')} and, where it is missing, the system's OpenGL library (libGL), or take the "
            "mean of the posterior"
        ) from error
    points, normals = (rows.astype(np.float64) for rows in cloud.to_numpy())
    require(
        len(points) >= 4,
        f"the cloud has {len(points)} points, and a surface needs at least 4: scan more of the object",
    )
    is_finite = bool(np.isfinite(points).all() and np.isfinite(normals).all())
    require(is_finite, "the cloud has points or normals that are not finite: build it with PointCloud.from_arrays")
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(vertex_matrix=points, v_normals_matrix=normals))
    # Only one thread is used, since several threads would change the last bits from run to run.
    meshes.generate_surface_reconstruction_screened_poisson(depth=depth, threads=1)
    reconstruction = meshes.current_mesh()
    vertices, faces = reconstruction.vertex_matrix(), reconstruction.face_matrix()
    require(
        len(faces) > 0,
        f"Poisson reconstruction at depth {depth} found no surface through {len(points)} points: scan more of the "
        "object, or raise the depth",
    )
    return TriangleMesh(vertices, faces.astype(np.int64), Frame())
