"""Heat diffusion over scanned points and triangle meshes, by sparse linear algebra on the host.

    du/dt = Delta u + f,     (M + h L) u_{k+1} = M (u_k + h f)

u is the temperature, f the heating, and h the length of a time step. The matrices L and M of a `Laplacian` are those of
Sharp and Crane (2020, "A Laplacian for Nonmanifold Triangle Meshes"), built on the tufted cover of the triangles. For
point clouds, the triangles come from a local triangulation of each point's neighbours. No heat flows across open edges.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from jaxnbv.checks import AnyArray, as_numbers, check_fields, is_traced, require
from jaxnbv.errors import optional

# Number of neighbours in the local triangulation of a point, as in Sharp and Crane.
_NEIGHBOURS = 30


def _array(source) -> AnyArray:
    # Anything but a JAX array becomes a NumPy array, because worker processes cannot use JAX's devices.
    return source if isinstance(source, Array) else as_numbers(source, "the heat source")


class HeatProblem(eqx.Module):
    """A body of uniform temperature, heated near a point: the paper's du/dt = Delta u + f, u(0) = u0.

    - `source`, `radius`: centre and radius of a ball, in scene coordinates. The heating f is `power` in the ball and
      zero elsewhere, smoothed at the rim, see `heating`. A body that does not reach the ball is not heated.
    - `power`: value of f, in degrees per unit of time. The diffusivity is one squared scene unit per unit of time.
    - `duration`, `steps`: time of heating T, and number of steps of implicit Euler, each of length h = T / steps.
    - `initial`: initial temperature u0, in degrees.

    **Raises:** `ValueError` for a source that is not one finite point, a radius or duration that is not positive, less
    than one step, or a power or initial temperature that is not finite.
    """

    source: Float[AnyArray, "3"] = eqx.field(converter=_array)
    radius: float = eqx.field(static=True, default=0.1)
    power: float = eqx.field(static=True, default=10.0)
    duration: float = eqx.field(static=True, default=5.0)
    steps: int = eqx.field(static=True, default=20)
    initial: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        check_fields(self)
        if not is_traced(self.source):
            require(
                self.source.shape == (3,) and bool(np.isfinite(self.source).all()),
                f"the heat source is {self.source}; it must be one point, three finite scene coordinates",
            )
        for name in ("radius", "duration"):
            require(getattr(self, name) > 0, f"the heat problem's {name} is {getattr(self, name)}; it must be positive")
        require(self.steps >= 1, f"the number of time steps is {self.steps}; it must be at least 1")

    @property
    def highest(self) -> float:
        """Upper bound of the temperature, initial + duration * max(0, power), by the maximum principle."""
        return self.initial + self.duration * max(0.0, self.power)

    def heating(self, points: Float[np.ndarray, "n 3"], areas: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """Return the heating f of each point.

        A point stands for a disc of its area (`areas`). f is `power` times the fraction of the disc in the heated ball.
        This fraction is approximated by 1/2 + (radius - d) / (2 rho), clipped to [0, 1], where d is the distance of the
        point from the source and rho the radius of the disc. In the authors' code, the fraction is 0 or 1. That makes
        no difference for dense points. But with 1,024 points on an object, the lowest temperatures of two random
        samplings differ by a third with the authors' code, and by a tenth with fractions.
        """
        distance = np.linalg.norm(points - np.asarray(self.source, np.float64), axis=1)
        return self.power * np.clip(0.5 + 0.5 * (self.radius - distance) / np.sqrt(areas / np.pi), 0.0, 1.0)


class Laplacian(NamedTuple):
    """The weak Laplacian of n points: Delta u = -u @ weak / mass for values u at the points.

    - `weak`: the matrix L, (n, n), symmetric and positive semidefinite. Its rows sum to zero, so heat is conserved.
    - `mass`: diagonal of the matrix M, which is the positive area of each point.
    """

    weak: sparse.csc_matrix
    mass: Float[np.ndarray, " n"]


class Temperature(NamedTuple):
    """The solution of a `HeatProblem` after its duration.

    - `values`: temperature of each point, in degrees.
    - `reached`: mask of the points that are connected to a heated point. Other points keep the initial temperature.
    """

    values: Float[np.ndarray, " n"]
    reached: Bool[np.ndarray, " n"]

    def coldest(self, reached_only: bool) -> int | None:
        """Return the index of the coldest point, or of the coldest `reached` point; None if there is none."""
        candidates = np.flatnonzero(self.reached) if reached_only else np.arange(len(self.values))
        return int(candidates[np.argmin(self.values[candidates])]) if len(candidates) else None


def cloud_laplacian(points: Float[np.ndarray, "n 3"]) -> Laplacian:
    """Return the Laplacian of a point cloud without coincident points.

    Each point is connected to some of its 30 nearest neighbours (fewer in a small cloud), however far away they are.
    Therefore two groups of points are disconnected only if they are far apart and each has more than 30 points. Points
    without a triangle, such as points on a single line, conduct no heat.
    """
    if len(points) == 3:
        # The library reads uninitialised memory if there are only two neighbours.
        is_triangle = np.linalg.matrix_rank(points[1:] - points[0]) == 2
        return mesh_laplacian(points, np.array([[0, 1, 2]])) if is_triangle else _insulator(3)
    neighbours = min(_NEIGHBOURS, len(points) - 1)
    laplacian = optional("robust_laplacian").point_cloud_laplacian
    return _assemble(lambda: laplacian(points, n_neighbors=neighbours), len(points))


def mesh_laplacian(vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]) -> Laplacian:
    """Return the Laplacian of a mesh, which may be non-manifold. Heat flows across shared vertices."""
    return _assemble(lambda: optional("robust_laplacian").mesh_laplacian(vertices, faces), len(vertices))


def _insulator(count: int) -> Laplacian:
    return Laplacian(sparse.csc_matrix((count, count)), np.ones(count))


def _assemble(build: Callable, count: int) -> Laplacian:
    if count < 3:
        return _insulator(count)
    try:
        weak, mass = build()
    except RuntimeError as error:
        # The library raises this error if there is no triangle at all.
        if "unreferenced vertex" not in str(error):
            raise
        return _insulator(count)
    # The library returns a row that does not sum to zero for a point without triangles, as if it were in contact with a
    # body at zero degrees. Set the diagonal so that all rows sum to zero, which isolates the point.
    flow = weak - sparse.diags(weak.diagonal())
    flow.eliminate_zeros()
    return Laplacian((flow - sparse.diags(np.asarray(flow.sum(axis=1)).ravel())).tocsc(), mass.diagonal())


def diffuse(
    laplacian: Laplacian,
    initial: Float[np.ndarray, " n"],
    heating: Float[np.ndarray, " n"],
    duration: float,
    steps: int,
) -> Float[np.ndarray, " n"]:
    """Return the temperature after `duration`, by implicit Euler: (M + h L) u_{k+1} = M (u_k + h f).

    u_k is the temperature and f the heating at each point, and h = duration / steps. The method is stable for any h,
    and its error is of order h. The total heat, mass @ u, grows by h mass @ f in each step.
    """
    step = duration / steps
    # The matrix is symmetric positive definite, so no pivoting is needed, and a fill-reducing order can be used.
    system = sparse.diags(laplacian.mass) + step * laplacian.weak
    factors = splu(system.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    u = initial
    for _ in range(steps):
        u = factors.solve(laplacian.mass * (u + step * heating))
    return u


def cloud_temperature(points: Float[np.ndarray, "n 3"], heat: HeatProblem) -> Temperature:
    """Return the temperature of a point cloud in scene coordinates. Coincident points count as one.

    **Raises:** `ValueError` for points that are not finite.
    """
    points, rows = _merge(points)
    return _solve(cloud_laplacian(points), points, rows, heat)


def mesh_temperature(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], heat: HeatProblem
) -> Temperature:
    """Return the temperature at the vertices of a mesh in scene coordinates.

    The temperature is linear between vertices, so `refine` a coarse mesh first. Coincident vertices count as one, so
    heat also flows between the triangles of a triangle soup.

    **Raises:** `ValueError` for vertices that are not finite.
    """
    vertices, rows = _merge(vertices)
    faces = rows[faces]
    is_proper = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return _solve(mesh_laplacian(vertices, faces[is_proper]), vertices, rows, heat)


def _merge(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distinct points, sorted, and the row of each point among the distinct points."""
    bad_rows = np.flatnonzero(~np.isfinite(points).all(axis=1))
    require(
        bad_rows.size == 0, f"{bad_rows.size} points are not finite, the first at row {bad_rows[:1]}: drop these rows"
    )
    distinct, rows = np.unique(np.asarray(points, np.float64), axis=0, return_inverse=True)
    return distinct, rows.reshape(-1)


def _solve(laplacian: Laplacian, points: np.ndarray, rows: np.ndarray, heat: HeatProblem) -> Temperature:
    heating = heat.heating(points, laplacian.mass)
    # No heat flows between different connected components.
    _, pieces = connected_components(laplacian.weak, directed=False)
    is_reached = np.isin(pieces, pieces[heating != 0.0])
    values = np.full(len(points), float(heat.initial))
    if is_reached.any():
        values = diffuse(laplacian, values, heating, heat.duration, heat.steps)
        # The solver makes rounding errors, but the initial temperature must be exact.
        values[~is_reached] = heat.initial
    return Temperature(values[rows], is_reached[rows])


def refine(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], longest: float
) -> tuple[Float[np.ndarray, "w 3"], Int[np.ndarray, "g 3"]]:
    """Bisect edges until none is longer than `longest`, and return the new vertices and faces.

    An edge is bisected in all its triangles at once. The original vertices come first in the result. Triangles may
    become slivers, but this does not harm the Laplacian of Sharp and Crane.

    **Raises:** `ValueError` if `longest` is not positive.
    """
    require(longest > 0, f"the longest edge is {longest}; it must be positive")
    while True:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1)
        lengths = np.linalg.norm(vertices[edges[..., 0]] - vertices[edges[..., 1]], axis=-1)
        if not (lengths > longest).any():
            return vertices, faces
        split, midpoint = np.unique(edges[lengths > longest], axis=0, return_inverse=True)
        halves = np.full(lengths.shape, -1)
        halves[lengths > longest] = len(vertices) + midpoint.reshape(-1)
        vertices = np.concatenate([vertices, vertices[split].mean(axis=1)])
        faces = _split_faces(faces, halves)


def _split_faces(faces: np.ndarray, halves: np.ndarray) -> np.ndarray:
    """Split triangles at the midpoints of their edges.

    - `halves`: index of the vertex at the midpoint of each edge (i, i + 1); -1 for an edge that is not bisected.
    """
    count = (halves >= 0).sum(axis=1)
    # Rotate each triangle, so that a single midpoint is on the first edge, and two are on the first two edges.
    first = np.where(count == 2, np.argmin(halves, axis=1) + 1, np.argmax(halves, axis=1))
    order = (first[:, None] + np.arange(3)) % 3
    (a, b, c), (x, y, z) = (np.take_along_axis(rows, order, axis=1).T for rows in (faces, halves))
    patterns = {
        0: [(a, b, c)],
        1: [(a, x, c), (x, b, c)],
        2: [(x, b, y), (a, x, y), (a, y, c)],
        3: [(a, x, z), (x, b, y), (z, y, c), (x, y, z)],
    }
    return np.concatenate([np.stack(t, axis=1)[count == n] for n, triples in patterns.items() for t in triples])
