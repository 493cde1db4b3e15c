"""Calls that once failed by an internal error, or silently gave a wrong value, raise an `InputError`: `python
refused.py`.

This is a program of its own, because in the tests beartype checks annotations before anything else.
"""

import dataclasses
import functools
import operator
import os
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

import jaxnbv as nbv
from jaxnbv.networks import (
    CloudClassifier,
    CloudSegmenter,
    InvariantClassifier,
    load_checkpoint,
    part_segmenter,
    pretrained_classifier,
)
from jaxnbv.storage import folders
from jaxnbv.studies.engine.records import read_records

# Kept until the program ends.
_HELD = tempfile.TemporaryDirectory()
FOLDER = Path(_HELD.name)
WEIGHTS = Path(nbv.__file__).parent / "networks" / "weights"
KEY = jax.random.key(0)
BALL = nbv.SDFSurface(nbv.sdf.Sphere(1.0))
POSE = nbv.look_at((0.0, 0.0, 2.5))
POSES = nbv.SphereCandidates(6).poses()
SMALL = nbv.Camera(height=6, width=6)
SCAN = nbv.scan(BALL, SMALL, POSE)
SCANS = nbv.scan(BALL, SMALL, POSES)
D = np.random.default_rng(0).normal(size=(60, 3))
D /= np.linalg.norm(D, axis=1, keepdims=True)
CLOUD = nbv.PointCloud.from_arrays(D, D)
SHOT = np.asarray((SCAN.points - POSE.position) @ POSE.forward).reshape(6, 6), np.asarray(POSE.matrix)
VIEW = nbv.View(POSE, SCAN, CLOUD, None, SMALL)
NO_POINTS = nbv.PointCloud(CLOUD.points, CLOUD.normals, jnp.zeros(60, bool))
NOT_FINITE = nbv.PointCloud(CLOUD.points.at[0].set(jnp.nan), CLOUD.normals, CLOUD.mask)
MODEL = nbv.GeometricSPSR(0.05, 0.2, 6)
POSTERIOR = MODEL.condition(CLOUD)
MAP = D + np.array([5e6, 4e5, 100.0])
SEGMENTER, CLASSIFIER = (load_checkpoint(WEIGHTS / f"{name}.safetensors") for name in ("parts", "pyramid"))


def planner(acquisition=nbv.Coverage(), grid=nbv.Grid(12), max_views=4):  # noqa: B008
    sampler = nbv.SurfaceSampler(MODEL, grid, num_samples=2)
    return nbv.Planner(acquisition, nbv.DiscreteSearch(6), SMALL, sampler, capacity=64, max_views=max_views)


P = planner()
OBSERVATIONS = P.init(POSE, SCAN)
FULL = planner(max_views=1).init(POSE, SCAN)


def proposed(acquisition):
    return planner(acquisition=acquisition).propose(planner(acquisition=acquisition).init(POSE, SCAN), KEY)


def parts_of(answer):
    return proposed(nbv.ExpectedUtilityImprovement(nbv.SoftPartCount(lambda cloud: answer), 16))


def greatest_by_numpy(cloud):
    return np.max(np.asarray(cloud.points)[:, 1])


def first_if_positive(cloud):
    return cloud.points[0, 0] if cloud.points[0, 0] > 0 else jnp.zeros(())


class Deciding(nbv.Acquisition):
    """An acquisition that branches on a traced value."""

    def context(self, step):
        return None

    def score(self, context, view):
        return jnp.ones(()) if view.scan.points[0, 0] > 0 else jnp.zeros(())


def expected(acquisition):
    acquisition = nbv.Planner(acquisition).acquisition
    surfaces = P.sampler.sample(CLOUD, KEY)
    return nbv.expected_value(acquisition, CLOUD, surfaces, SMALL, POSES)


def session(**changes):
    settings = {"planner": P, "camera": SMALL, "box": ((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2)), "up": "y"}
    return nbv.Session(**(settings | changes))


def stored(name, changes):
    file = WEIGHTS / "pyramid.safetensors"
    with safe_open(file, "numpy") as opened:
        metadata = opened.metadata()
    save_file(changes(load_file(file)), FOLDER / name, metadata)
    return load_checkpoint(FOLDER / name)


def large_view():
    """A view of zero arrays, which expand to more than is allowed."""
    folder = FOLDER / "episode"
    nbv.simulate(P, BALL, POSE, 1, KEY, folder=folder, progress=False)
    np.savez_compressed(folder / "view_00.npz", points=np.zeros(2**19))
    folders.MAX_ARRAY_BYTES = 2**20
    nbv.simulate(P, BALL, POSE, 1, KEY, folder=folder, progress=False)


def folder_of_images(name, count=3):
    """A session with some images on disk."""
    stored = session(folder=FOLDER / name)
    for _ in range(count):
        stored.add(*SHOT)
    return FOLDER / name


def reopened(name, change):
    """Open a session again after its folder was changed."""
    change(folder_of_images(name))
    return session(folder=FOLDER / name)


def piped(folder):
    (folder / "image_01.npz").unlink()
    os.mkfifo(folder / "image_01.npz")


def dangling(folder):
    (folder / "image_01.npz").unlink()
    (folder / "image_01.npz").symlink_to("elsewhere.npz")


def older_session_asks():
    older, newer = (session(folder=FOLDER / "two") for _ in range(2))
    newer.add(*SHOT)
    older.next()


def mesh_of_text(name, text):
    (FOLDER / name).write_text(text)
    return nbv.load_mesh(FOLDER / name)


def records(name):
    (FOLDER / name).mkdir()
    (FOLDER / name / "scene_x.json").write_text("{}")
    return read_records(FOLDER / name)


def costing(cost):
    """A step with a cost of travel."""
    priced = dataclasses.replace(P, cost=nbv.ValuePerCost(cost))
    return priced.propose(priced.init(POSE, SCAN), KEY)


def infinite_later(cloud):
    """A utility that is infinite for large clouds."""
    return jnp.where(jnp.sum(cloud.mask) > 36, jnp.inf, 0.0)


class NaNView(nbv.search.Baseline):
    """A baseline whose values are NaN."""

    def values(self, problem, candidates, key):
        return jnp.full(self.candidates.count, jnp.nan)


def nan_baseline():
    asks = nbv.Planner(nbv.Coverage(), NaNView(6), SMALL, P.sampler, capacity=64)
    return asks.propose(asks.init(POSE, SCAN), KEY)


class Saying(nbv.StopRule):
    """A stop rule that returns a given reason."""

    reason: object = eqx.field(static=True)

    def after(self, context):
        return self.reason


def stopping(reason, *others):
    until = functools.reduce(operator.or_, (Saying(reason), *others))
    return nbv.simulate(P, BALL, POSE, 3, KEY, progress=False, until=until)


def nested(depth):
    value = []
    for _ in range(depth):
        value = [value]
    return value


BOAST = "OFF\n3 10000000 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
NEVER = nbv.SurfaceSampler(MODEL, nbv.Grid(12), 2, nbv.Carving(lambda x: jnp.full(x.shape[:1], jnp.nan)))

# Calls, and words that the error must contain.
REFUSED = {
    "index beyond a batch": (lambda: POSES[6], "no index 6"),
    "iteration of a single pose": (lambda: list(POSE), "a single one"),
    "observations without room": (lambda: P.observe(FULL, POSE, SCAN), "max_views"),
    "observations of another grid's extent": (
        lambda: planner(grid=nbv.Grid(12, 1.5)).propose(OBSERVATIONS, KEY),
        "carved on Grid(resolution=12, half_extent=1.5)",
    ),
    "a map's coordinates": (lambda: nbv.Frame.fit(MAP).to_scene(nbv.PointCloud.from_arrays(MAP, D)), "rounded"),
    "points of the plane": (lambda: POSTERIOR.variance(D[:, :2]), "(60, 2)"),
    "a grid beyond the torus": (lambda: nbv.SurfaceSampler(MODEL, nbv.Grid(12, 9.4)).mean_mesh(CLOUD), "9.4"),
    "a number as a mesh of a bank": (lambda: nbv.ShapeBank.from_meshes(["a.ply", 5]), "a mesh is 5"),
    "points beyond the torus": (lambda: POSTERIOR.probability_inside(10.0 * D), "9.978"),
    "nodes that are not finite": (lambda: POSTERIOR.sample(KEY, 2).on_grid(np.array([np.nan, 1.0])), "nan"),
    "logits of parts": (lambda: parts_of(jnp.full((16, 3), 4.0)), "softmax"),
    "a ragged image": (lambda: nbv.PointCloud.from_depth([[2.0] * 6] * 5 + [[1]], SMALL, POSE), "numbers"),
    "a batch of scans": (lambda: P.init(None, SCANS), "batch"),
    "a batch of poses": (lambda: P.init(POSES, SCAN), "batch"),
    "no pose": (lambda: P.observe(OBSERVATIONS, None, SCAN), "None"),
    "a cloud in place of observations": (lambda: P.propose(SCAN, KEY), "give Observations"),
    "observations as the inputs of a step": (lambda: P.choose(OBSERVATIONS, KEY), "give StepInputs"),
    "a number as a key": (lambda: P.propose(OBSERVATIONS, 0), "jax.random.key"),
    "a batch of first poses": (lambda: nbv.simulate(P, BALL, POSES, 1, KEY), "batch"),
    "rows that differ in number": (
        lambda: nbv.PointCloud(jnp.zeros((3, 3)), jnp.zeros((2, 3)), jnp.ones(3, bool)),
        "(2, 3)",
    ),
    "rays that differ in number": (lambda: nbv.PointCloud(SCAN.points, SCAN.normals, SCAN.mask, SCAN.mask[:5]), "(5,)"),
    "a mask of numbers": (lambda: nbv.PointCloud(CLOUD.points, CLOUD.normals, jnp.ones(60)), "boolean"),
    "a batch to measure": (
        lambda: nbv.scanning.metrics.coverage([nbv.View(POSE, SCANS, CLOUD, None, SMALL)], D),
        "rows of shape",
    ),
    "text as a cloud": (lambda: nbv.ScreenedSPSR(MODEL).condition("x"), "'x'"),
    "complex coordinates": (lambda: nbv.PointCloud.from_arrays(D + 1j, D), "real numbers"),
    "text for a frame": (lambda: nbv.Frame().to_scene("x"), "real numbers"),
    "a masked truth": (
        lambda: nbv.scanning.metrics.coverage([VIEW], np.ma.masked_array(D, D > 0)),
        "masked",
    ),
    "normals of points of the plane": (lambda: nbv.geometry.estimate_normals(D[:, :2], (0.0, 0.0, 5.0)), "(60, 2)"),
    "text as a radius": (lambda: nbv.sdf.Sphere("x"), "'x'"),
    "a turn about the plane": (lambda: nbv.sdf.Sphere(1.0).rotate([0.0, 1.0], 1.0), "(2,)"),
    "united with a number": (lambda: nbv.sdf.Union(nbv.sdf.Sphere(1.0), 3), "is 3"),
    "half a point": (
        lambda: nbv.mesh_from_sdf(nbv.sdf.Sphere(1.0), nbv.Grid(12)).sample_points(KEY, 2.5),
        "2.5",
    ),
    "a negative temperature": (
        lambda: stored("t.safetensors", lambda a: a | {"temperature": np.full((), -1, np.float32)}),
        "temperature",
    ),
    "weights beyond 32 bits": (
        lambda: stored("h.safetensors", lambda a: {k: np.asarray(v.astype(np.float64) * 1e300) for k, v in a.items()}),
        "not finite",
    ),
    "a view of gigabytes": (large_view, "unpacks to"),
    "a long name": (lambda: nbv.load_mesh("a" * 5000 + ".obj"), "no mesh file"),
    "a name that ends early": (lambda: nbv.simulate(P, BALL, POSE, 1, KEY, folder="/tmp/a\0b"), "cannot make"),
    "too large a capacity": (lambda: nbv.PointCloud.from_arrays(D, D, 10**13), "capacity"),
    "half a category": (lambda: CloudSegmenter(SEGMENTER, 2.5), "2.5"),
    "too few classes": (lambda: proposed(nbv.CrossEntropy(CloudClassifier(CLASSIFIER, classes=("a",)), 16)), "names 1"),
    "a utility of NumPy, alone": (lambda: expected(greatest_by_numpy), "HostClassifier"),
    "a utility that decides": (lambda: proposed(first_if_positive), "jnp.where"),
    "an acquisition that decides, alone": (lambda: expected(Deciding()), "jnp.where"),
    "probabilities of a class, alone": (
        lambda: expected(nbv.CrossEntropy(lambda _: jnp.array([0.3, 0.7]))),
        "log_softmax",
    ),
    "one score as several": (lambda: nbv.AcquisitionList(nbv.Coverage()), "a tuple"),
    "intrinsics of four rows": (lambda: nbv.Camera.from_intrinsics(np.eye(4), 6, 6), "(4, 4)"),
    "a rotation as a pose": (lambda: nbv.Pose.from_matrix(np.eye(3)), "(3, 3)"),
    "poses of a session that are one": (lambda: session(poses=np.eye(4)), "give a batch"),
    "a session without up": (lambda: session(up=None), 'up="z"'),
    "a depth image of text": (lambda: session().add("image", np.eye(4)), "'image'"),
    "a rule of an episode that is none": (
        lambda: nbv.simulate(P, BALL, POSE, 2, KEY, progress=False, until="sure"),
        "'sure'",
    ),
    "parts that are no names": (lambda: nbv.PartsFound(parts=3), "3"),
    "a boundary of text": (
        lambda: nbv.surfaces.OutsideBoundary(lambda x: "far"),
        "gives no signed distances of points",
    ),
    "a gap among images": (lambda: reopened("gap", lambda f: (f / "image_01.npz").unlink()), "not image_01.npz"),
    "a link to no image": (lambda: reopened("link", dangling), "image_01.npz is damaged"),
    "a pipe as an image": (lambda: reopened("pipe", piped), "image_01.npz is damaged"),
    "an older session that asks": (older_session_asks, "another process has added some"),
    "a scene without a number": (lambda: records("unnumbered"), "scene_x.json is not a record"),
    "a mesh that is no file": (lambda: nbv.load_mesh(D), "give str or Path or Trimesh or Scene"),
    "a face of ten million": (lambda: mesh_of_text("boast.off", BOAST), "of the 10000000 faces"),
    "a cost that is not a number": (lambda: costing(lambda a, b: jnp.nan * b.position[0]), "the cost of going"),
    "a utility that is infinite later": (lambda: proposed(infinite_later), "points is inf: it must be finite"),
    "a utility of nothing": (lambda: planner(lambda cloud: None), "the utility of a cloud is None"),
    "a utility of complex numbers": (
        lambda: planner(lambda cloud: jnp.sum(cloud.points) * 1j),
        "a utility is one number",
    ),
    "a classifier of one number": (lambda: planner(nbv.CrossEntropy(lambda c: jnp.zeros(()), 16)), "the classifier"),
    "a segmenter of rows": (lambda: planner(nbv.SoftPartCount(lambda c: c.mask)), "the segmenter's answer"),
    "a baseline of NaN": (nan_baseline, "the value of NaNView is not a number"),
    "a rule that says nothing": (lambda: stopping(""), "None to go on"),
    "a rule of a number in two": (lambda: stopping(0.5, nbv.Budget(seconds=1e9)), "Saying returned 0.5"),
    "a utility by a mask": (
        lambda: planner(lambda cloud: jnp.max(cloud.points[cloud.mask][:, 1])),
        "jnp.where(cloud.mask",
    ),
    "a utility that counts": (lambda: planner(lambda cloud: float(len(range(cloud.mask.sum())))), "jax.numpy"),
    "an acquisition that decides, first": (lambda: planner(Deciding()).init(POSE, SCAN), "jnp.where"),
    "a mesh without a frame": (lambda: nbv.TriangleMesh(np.eye(3), np.array([[0, 1, 2]])), "from_arrays"),
    "a camera in millimetres": (
        lambda: nbv.simulate(P, BALL, nbv.look_at((0.0, 0.0, 2500.0)), 1, KEY, progress=False),
        "2500 scene units",
    ),
    "a second camera in millimetres": (
        lambda: P.observe(OBSERVATIONS, nbv.look_at((0.0, 0.0, 2500.0)), SCAN),
        "Frame.to_scene",
    ),
    "a cost of three numbers": (lambda: costing(lambda a, b: b.position), "one number a pose"),
    "a cost of NumPy": (lambda: costing(lambda a, b: np.linalg.norm(b.position)), "jax.numpy"),
    "a rule or text": (lambda: nbv.Sure(0.9) | "x", "'x'"),
    "an inverse of intrinsics": (
        lambda: nbv.Camera.from_intrinsics(np.linalg.inv([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]]), 480, 640),
        "intrinsic matrix",
    ),
    "a volume of no numbers": (
        lambda: dataclasses.replace(P, sampler=NEVER).init(POSE, SCAN),
        "outside the volume",
    ),
    "a volume of one number": (lambda: nbv.Carving(lambda x: jnp.sum(x)), "one number per point"),
    "a volume of NumPy": (lambda: nbv.Carving(lambda x: np.linalg.norm(x, axis=1)), "jax.numpy"),
    "two points of three values": (
        lambda: nbv.surfaces.ValueRows(jnp.zeros((2, 3)), jnp.zeros(3), jnp.ones(3), jnp.ones(3, bool)),
        "give (m, 3)",
    ),
    "what is allowed three times": (lambda: nbv.SphereCandidates(6).where(lambda p: p.position > 0), "True or False"),
    "a list in lists": (lambda: nbv.PointCloud.from_arrays(nested(5000), D), "nested too deep"),
    "noise below zero": (lambda: nbv.SensorNoise(points=-0.1), "must not be negative"),
    "a depth's noise below zero": (lambda: nbv.DepthNoise(-1.0), "deviation is -1.0"),
    "a depth's noise for another camera": (
        lambda: nbv.DepthNoise(0.1)(SCAN, KEY, nbv.Camera(), POSE),
        "give the camera that took it",
    ),
    "a ball of no size around a solid": (lambda: nbv.SDFSurface(nbv.sdf.Sphere(1.0), 0.0), "must be positive"),
    "values of another size": (
        lambda: nbv.scanning.GridSurface.from_values(np.zeros((9, 9, 9)), 0.0, nbv.Grid(12)),
        "do not fit a grid of 12",
    ),
    "values that are not finite": (
        lambda: nbv.scanning.GridSurface.from_values(np.full((12, 12, 12), np.nan), 0.0, nbv.Grid(12)),
        "not finite",
    ),
    "a batch of grids as one": (
        lambda: nbv.scanning.GridSurface.from_values(np.ones((2, 12, 12, 12)), 0.0, nbv.Grid(12)).trace(D, D),
        "scan_samples",
    ),
    "a grid turned inside out": (lambda: nbv.Grid(half_extent=-1.0), "half extent is -1"),
    **{
        f"no candidates for {kind.__name__}": (lambda kind=kind: kind(0), "0 candidates")
        for kind in (
            nbv.DiscreteSearch,
            nbv.HalvingSearch,
            nbv.FarthestView,
            nbv.RandomView,
            nbv.search.UncertaintyView,
        )
    },
    "no first samples": (lambda: nbv.HalvingSearch(9, 0), "num_first_samples is 0"),
    "an object out of the image": (
        lambda: nbv.Planner(nbv.Coverage(), nbv.GradientSearch(space=nbv.search.ConstrainedPoses(off_axis=0.3))),
        "off_axis is 0.3 rad but the image ends 0.262 rad",
    ),
    "a utility as a second question": (lambda: nbv.search.TieBreakSearch(12, second=lambda cloud: 0.0), "second"),
    "no samples of a posterior": (lambda: POSTERIOR.sample(KEY, 0), "asked for 0 samples"),
    "a target of no points": (lambda: nbv.SoftPartCount(lambda cloud: None, 0.0), "N_target is"),
    "no points for a classifier": (lambda: CloudClassifier(CLASSIFIER, num_points=0), "num_points is 0"),
    "classes from a segmenter": (lambda: CloudClassifier(SEGMENTER), "give it to CloudSegmenter"),
    "objects without a side": (lambda: pretrained_classifier("pyramid", 0.0), "longest side is 0.0"),
    "a classifier that does not ship": (
        lambda: pretrained_classifier("teapot"),
        "there is no shipped classifier 'teapot': ",
        "choose from pyramid",
    ),
    "a category that does not ship": (lambda: part_segmenter("spoon"), "category 'spoon'"),
    "a segmenter of seven parts": (
        lambda: CloudSegmenter(lambda *_: jnp.zeros((60, 7)), 3, num_points=60)(CLOUD),
        "has 7 parts",
    ),
    **{
        f"levels of {levels}": (
            lambda levels=levels: InvariantClassifier(5, KEY, **levels),
            "the second level no more groups",
        )
        for levels in ({"groups": (64, 65)}, {"groups": (64, 0)}, {"radii": (0.2, 0.0)})
    },
    "more views than there is room for": (
        lambda: nbv.simulate(P, BALL, POSE, 7, KEY, progress=False),
        "asked for 7 views",
        "room for 4",
        "max_views",
    ),
    "normals without length": (
        lambda: P.init(None, nbv.PointCloud(CLOUD.points, CLOUD.normals.at[1].set(0.0), CLOUD.mask)),
        "1 normals ",
        "from_arrays",
    ),
}


def problem(action, *words):
    """The problem of a refusal, or None."""
    try:
        action()
    except nbv.InputError as error:
        missing = [word for word in words if word not in str(error)]
        return f"says {str(error)[:200]!r} without {missing}" if missing else None
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"{type(error).__name__}: {str(error)[:150]!r} ({where.filename}:{where.lineno})"
    return "is accepted"


def main() -> None:
    warnings.simplefilter("ignore")
    problems = {name: problem(*case) for name, case in REFUSED.items()}
    print("\n".join(f"{name}: {message}" for name, message in problems.items() if message))
    sys.exit(any(problems.values()))


if __name__ == "__main__":
    main()
