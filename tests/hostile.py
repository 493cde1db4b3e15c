"""Any argument of a public constructor or function works or raises `InputError`: `python tests/hostile.py`.

This is a program of its own, because in the tests beartype checks annotations before anything else.
"""

import contextlib
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import HealthCheck, Phase, given, settings

import jaxnbv as nbv
from jaxnbv import readers

RNG = np.random.default_rng(0)
DIRECTIONS = RNG.normal(size=(20, 3))
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
CLOUD = nbv.PointCloud.from_arrays(DIRECTIONS, DIRECTIONS)
POSE = nbv.look_at((0.0, 0.0, 2.5))
POSES = nbv.SphereCandidates(6).poses()
SMALL = nbv.Camera(height=4, width=4)
BALL = nbv.sdf.Sphere(1.0)
MODEL = nbv.GeometricSPSR(0.05, 0.2, 6)
RESIDUAL = nbv.ScreenedSPSR(MODEL, (nbv.surfaces.OnSurface(),))
BANK = nbv.ShapeBank.of([BALL])
# Kept until the program ends.
_HELD = tempfile.TemporaryDirectory()
COPY = Path(_HELD.name)
for name, content in {
    "bed/test/bed_0516.off": "",
    "bed/bed_0516.txt": "",
    "modelnet10_shape_names.txt": "bed",
    "modelnet10_test.txt": "bed_0516",
    "02958343/a/model.obj": "",
    "raw_scans/apple/apple_001/Scan/Scan.obj": "",
    "point_clouds/ply_files/1024/apple/apple_001/pcd_1024.ply": "",
    "synsetoffset2category.txt": "Car 02958343",
    "train_test_split/shuffled_test_file_list.json": '["shape_data/02958343/a"]',
    "02958343/a.txt": "",
}.items():
    (COPY / name).parent.mkdir(parents=True, exist_ok=True)
    (COPY / name).write_text(content)


# An empty file, so that no mesh is cached.
MESH = COPY / "02958343" / "a" / "model.obj"


def number_of_points(cloud):
    return jnp.sum(cloud.mask).astype(float)


def chosen_of_bank(indices):
    return BANK.select(indices)


def with_bank(bank, poses):
    return nbv.SurfaceSampler().with_bank(bank, poses)


# Functions, and arguments that work. Each argument is replaced in turn.
CALLS = {
    nbv.Budget: {"seconds": 60.0, "cost": 3.0, "of": nbv.arc_length},
    nbv.Box: {"low": (-1.0, -1.0, -1.0), "high": (1.0, 1.0, 1.0)},
    nbv.Camera: {"fov": 0.5, "height": 4, "width": 4, "aspect": 1.0, "center": (0.5, 0.5), "nearest": 0.1}
    | {"farthest": 3.0, "max_incidence": 1.0},
    nbv.Camera.from_intrinsics: {"matrix": np.eye(3), "height": 4, "width": 4, "nearest": 0.1, "farthest": 3.0}
    | {"max_incidence": 1.0, "distortion": (0.1, 0.0, 0.0, 0.0)},
    SMALL.resized: {"height": 2, "width": 3},
    SMALL.strided: {"stride": 2},
    nbv.Carving: {"volume": nbv.Box(), "margin_voxels": 1.0},
    nbv.ColdestPoint: {"heat": (0.0, 1.0, 0.0), "reached_only": False, "workers": 1},
    nbv.search.ConstrainedPoses: {"nearest": 2.0, "farthest": 3.0, "off_axis": 0.1},
    nbv.CrossEntropy: {"classifier": number_of_points, "num_points": 16},
    nbv.DiscreteSearch: {"candidates": 6},
    nbv.tasks.EntropyReduction: {"classifier": number_of_points, "num_points": 16},
    nbv.ExpectedUtilityImprovement: {"utility": number_of_points, "num_points": 16},
    nbv.FarthestView: {"candidates": 6},
    nbv.Frame: {"scale": 1.0, "center": (0.0, 0.0, 0.0)},
    nbv.Frame.fit: {"points": DIRECTIONS, "longest_side": 2.5},
    nbv.search.FreePoses: {"radius": 2.5},
    nbv.GeometricSPSR: {"lengthscale": 0.05, "variance": 0.2, "truncation": 6, "noise": 0.01, "nu": 1.5},
    nbv.GivenPoses: {"batch": POSES},
    nbv.GradientSearch: {"dof": 2, "space": None, "num_starts": 2, "iterations": 2, "learning_rate": 0.01}
    | {"num_candidates": 6, "solver": None, "candidates": None},
    nbv.Grid: {"resolution": 8, "half_extent": 1.5},
    nbv.HalvingSearch: {"candidates": 6, "num_first_samples": 2},
    nbv.tasks.HeatProblem: {"source": (0.0, 1.0, 0.0), "radius": 0.1, "power": 10.0, "duration": 5.0, "steps": 2}
    | {"initial": 0.0},
    nbv.HostClassifier: {"function": number_of_points, "num_classes": 3},
    nbv.HostSegmenter: {"function": number_of_points, "num_parts": 3},
    nbv.SurfaceSampler: {"model": MODEL, "grid": nbv.Grid(8), "num_samples": 2, "carving": nbv.Carving()},
    nbv.SurfaceSampler.preset: {"name": "paper", "longest_side": 2.5, "quick": True, "volume": None, "solid": False},
    nbv.tasks.MixedEntropy: {"classifier": number_of_points, "threshold": 0.5, "num_points": 16},
    nbv.surfaces.OnSurface: {"num_points": 10, "noise": 0.1},
    nbv.surfaces.OutsideBoundary: {"volume": nbv.Box(), "num_points": 10, "value": 1.0, "noise": 0.5, "margin": 0.1},
    nbv.Planner: {"acquisition": nbv.Coverage(), "search": nbv.DiscreteSearch(6), "camera": SMALL}
    | {"sampler": nbv.SurfaceSampler(MODEL, nbv.Grid(8), 2), "cost": None, "capacity": 32, "max_views": 3}
    | {"obstacles": None},
    nbv.PointCloud.from_arrays: {"points": DIRECTIONS, "normals": DIRECTIONS, "capacity": 32},
    nbv.PointCloud.from_depth: {"depth": np.ones((4, 4)), "camera": SMALL, "pose": POSE}
    | {"depth_scale": 1.0, "stride": 2, "box": nbv.Box()},
    nbv.Pose.from_matrix: {"matrix": np.eye(4), "convention": "opengl"},
    nbv.Pose: {"rotation": np.eye(3), "position": np.zeros(3)},
    nbv.RandomView: {"candidates": 6},
    nbv.SDFSurface: {"sdf": BALL, "bounding_radius": 2.0},
    nbv.ScreenedSPSR: {"base": MODEL, "values": (nbv.surfaces.OnSurface(),), "level_deviation": 0.5, "offset": 0.1},
    nbv.surfaces.EmptySpace: {"num_points": 10, "value": 2.0, "noise": 1.0},
    nbv.SensorNoise: {"points": 0.01, "normals": 0.01},
    nbv.AcquisitionList: {"members": (nbv.Coverage(),)},
    nbv.SoftPartCount: {"segmenter": number_of_points, "target": 60.0},
    nbv.search.TieBreakSearch: {"candidates": 6, "second": nbv.Coverage()},
    nbv.SphereCandidates: {"count": 6, "radius": 2.5, "min_elevation": 0.0, "up": (0.0, 1.0, 0.0)},
    nbv.search.SpherePoses: {"radius": 2.5},
    nbv.TriangleMesh.from_arrays: {"vertices": np.eye(3), "faces": [[0, 1, 2]]},
    nbv.search.UncertaintyView: {"candidates": 6},
    readers.class_meshes: {"folder": COPY, "classes": ["bed"]},
    chosen_of_bank: {"indices": [0]},
    nbv.surfaces.AsGiven: {"scale": (0.9, 1.1), "by_axis": False},
    nbv.surfaces.FreeRotation: {"scale": (0.9, 1.1), "by_axis": False},
    with_bank: {"bank": BANK, "poses": nbv.surfaces.Upright()},
    nbv.surfaces.KnownShapes: {
        "bank": BANK,
        "residual": RESIDUAL,
        "poses": nbv.surfaces.Upright(),
        "box": nbv.Box(),
        "model_of_none": MODEL,
    }
    | {"num_starts": 8, "noise_scale": 0.1, "inverse_temperature": 20.0, "misfit_of_none": 0.6},
    nbv.ShapeBank.from_meshes: {"meshes": [MESH], "resolution": 8, "sheet": 0.05, "names": ["a"], "progress": False},
    nbv.ShapeBank.of: {"solids": [BALL], "names": ["ball"]},
    nbv.surfaces.Upright: {"axis": (0.0, 1.0, 0.0), "within": 1.0, "scale": (0.9, 1.1), "by_axis": False},
    nbv.shape_bank: {"name": "heat"},
    nbv.ValueBelow: {"value": 0.1},
    nbv.geometry.concatenate: {"first": CLOUD, "second": CLOUD},
    nbv.geometry.farthest_point_subsample: {"cloud": CLOUD, "count": 3},
    nbv.geometry.fibonacci_sphere: {"count": 6, "radius": 1.0, "min_elevation": 0.0},
    nbv.load_mesh: {"path": "nowhere.obj"},
    nbv.look_at: {"position": (0.0, 0.0, 2.5), "target": (0.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0)},
    nbv.mesh_from_sdf: {"sdf": BALL, "grid": nbv.Grid(8)},
    nbv.scan: {"surface": nbv.SDFSurface(BALL), "camera": SMALL, "pose": POSE},
}

NUMBERS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-3, 40),
    st.floats(),
    st.sampled_from([0.0, -1.0, 1e30, 1e-30, 2.5, 1j, 10**400, np.int64(3), np.float32(0.5), np.array(2.0)]),
)
ANYTHING = st.one_of(
    NUMBERS,
    st.text(max_size=5),
    st.lists(NUMBERS, max_size=4),
    st.tuples(NUMBERS, NUMBERS, NUMBERS),
    st.sampled_from([{}, {"a": 1}, object(), int, len, b"x", jax.random.key(0)]),
    st.sampled_from([np.zeros((2, 3)), np.full((4, 4), np.nan), np.array(["a"]), np.zeros((0, 3))]),
    st.sampled_from([np.ma.masked_array(np.ones((20, 3)), np.arange(60).reshape(20, 3) == 7)]),
    st.sampled_from([CLOUD, POSE, POSES, SMALL, BALL, MODEL, nbv.Coverage(), nbv.Grid(8), nbv.Coverage]),
)


def hold(function, arguments):
    """Assert that a call works, or raises an `InputError` that says what is wrong."""
    with contextlib.suppress(nbv.InputError):
        function(**arguments)


def test_of(function, usual, name, examples):
    @settings(
        max_examples=examples,
        derandomize=True,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate),
        suppress_health_check=list(HealthCheck),
    )
    @given(ANYTHING)
    def test(value):
        hold(function, usual | {name: value})

    return test


def main() -> None:
    warnings.simplefilter("ignore")
    examples = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    failures = []
    for function, usual in CALLS.items():
        hold(function, usual)
        for name in usual:
            try:
                test_of(function, usual, name, examples)()
            except Exception as error:
                where = traceback.extract_tb(error.__traceback__)[-1]
                problem = f"{type(error).__name__}: {str(error)[:150]!r} ({where.filename}:{where.lineno})"
                example = " ".join(getattr(error, "__notes__", ()))[-200:]
                failures.append(f"{function.__qualname__}({name}=...): {problem} {example}")
    print("\n".join(failures))
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
