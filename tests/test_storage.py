"""Episodes on disk: descriptions, exact round trips, PLY by two readers, kill and resume."""

import functools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from plyfile import PlyData

from jaxnbv.camera import Camera, look_at
from jaxnbv.checks import InputError
from jaxnbv.episode import simulate
from jaxnbv.planner import Planner
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise
from jaxnbv.scanning.sdf import Capsule, Sphere
from jaxnbv.search import DiscreteSearch, FarthestView, SphereCandidates
from jaxnbv.storage import EpisodeFolder, describe
from jaxnbv.surfaces import GeometricSPSR
from jaxnbv.tasks import Coverage

ROOT = Path(__file__).resolve().parents[1]
SCENE = SDFSurface(Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.3))
FIRST = look_at((0.8, 0.9, 2.2))
KEY = jax.random.key(0)


def planner_of(search=None, lengthscale=0.05, **changes):
    search = DiscreteSearch(12) if search is None else search
    settings = {"num_samples": 3, "grid": Grid(24), "capacity": 128, "max_views": 6, **changes}
    model, camera = GeometricSPSR(truncation=8, lengthscale=lengthscale), Camera(height=8, width=8)
    return Planner(model, camera, Coverage(), search, **settings)


BASE = {"planner": planner_of(), "scene": SCENE, "noise": SensorNoise(), "first": FIRST, "key": KEY}


def run(folder, views=3, **changes):
    return simulate(**(BASE | changes), views=views, folder=folder, progress=False)


def contents(folder):
    """Of all files but the lock."""
    return {file.name: file.read_bytes() for file in sorted(Path(folder).iterdir()) if file.name != ".lock"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "five"
    return run(folder, views=5), folder


CHANGES = {
    "model": {"planner": planner_of(lengthscale=0.051)},
    "search": {"planner": planner_of(FarthestView(12))},
    "candidates": {"planner": planner_of(DiscreteSearch(13))},
    "radius": {"planner": planner_of(DiscreteSearch(SphereCandidates(12, 2.6)))},
    "samples": {"planner": planner_of(num_samples=4)},
    "grid": {"planner": planner_of(grid=Grid(25))},
    "capacity": {"planner": planner_of(capacity=129)},
    "scene": {"scene": SDFSurface(Sphere(0.7))},
    "one number of the scene": {"scene": SDFSurface(Sphere(0.7) | Capsule([0.2, 0.3, -0.4], [0.5, 0.6, 0.9], 0.31))},
    "noise": {"noise": SensorNoise(points=0.02)},
    "first": {"first": look_at((0.8, 0.9, 2.3))},
    "key": {"key": jax.random.key(1)},
    "kind of key": {"key": jax.random.key(0, impl="rbg")},
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_description_tells_every_setting_apart(name):
    assert json.dumps(describe(BASE)) == json.dumps(describe(dict(BASE)))
    assert json.dumps(describe(BASE | CHANGES[name])) != json.dumps(describe(BASE))


def test_a_description_tells_large_arrays_and_functions_apart():
    large = np.zeros((40, 3))
    other = large.copy()
    other[17, 1] = 1e-300
    assert describe(large) == describe(large.copy())
    assert describe(large) != describe(other)
    assert describe(large) != describe(large.reshape(3, 40))
    assert describe(jnp.sin) != describe(jnp.cos)
    assert describe(lambda x: x + 1) != describe(lambda x: x + 2)

    def plus(amount, default=0):
        return lambda x, y=default: (lambda z: z + x + y)(amount)

    assert describe(plus(1.0)) == describe(plus(1.0))
    assert describe(plus(1.0)) != describe(plus(2.0))
    assert describe(plus(1.0, 1)) != describe(plus(1.0, 2))
    assert describe(functools.partial(plus, 1)) != describe(functools.partial(plus, 2))
    assert describe(jax.jit(plus(1.0))) != describe(jax.jit(plus(2.0)))
    assert json.loads(json.dumps(describe({"a": (1, 2.5, None, "x", large)})))["a"][:4] == [1, 2.5, None, "x"]


def test_a_description_of_a_function_is_the_same_in_every_process():
    code = "from jaxnbv.storage import describe; print(describe(lambda x: x in {'a', 'b', 'c'} and (lambda: 1)))"
    outputs = set()
    for seed in ("1", "2", "3"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        outputs.add(
            subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True).stdout
        )
    assert len(outputs) == 1


def test_views_come_back_with_the_same_bits(finished):
    episode, folder = finished
    config = describe({"planner": episode.planner, "scene": SCENE, "noise": SensorNoise(), "first": FIRST, "key": KEY})
    views = EpisodeFolder(folder, config).read_views()
    assert len(views) == 5
    assert views[0][2] is None
    for read, view in zip(views, episode.views, strict=True):
        written = (view.pose, view.scan, view.proposal)
        assert jax.tree.structure(read) == jax.tree.structure(written)
        for a, b in zip(jax.tree.leaves(read), jax.tree.leaves(written), strict=True):
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


def test_a_view_keeps_which_rays_missed_and_one_of_an_earlier_version_reads_without(finished, tmp_path):
    episode, folder = finished
    config = json.loads((folder / "episode.json").read_text())["config"]
    folder = shutil.copytree(folder, tmp_path / "copy")
    for read, view in zip(EpisodeFolder(folder, config).read_views(), episode.views, strict=True):
        assert 0 < np.asarray(read[1].missed).sum() < 64
        np.testing.assert_array_equal(read[1].missed, ~np.asarray(view.scan.mask))
    with np.load(folder / "view_01.npz") as saved:
        later = {"missed", "format", "index", "sha256"}
        older = {name: saved[name] for name in saved.files if name not in later}
    np.savez_compressed(folder / "view_01.npz", **older)
    views = EpisodeFolder(folder, config).read_views()
    assert [pair[1].missed is None for pair in views] == [False, True, False, False, False]
    np.testing.assert_array_equal(views[1][1].points, episode.views[1].scan.points)


def state_after(episode):
    first, *others = episode.views
    state = episode.planner.init(first.scan, first.pose)
    for view in others:
        state = episode.planner.observe(state, view.pose, view.scan)
    return state


def test_the_record_says_what_made_it(finished):
    record = json.loads((finished[1] / "episode.json").read_text())
    assert set(record["config"]) == {"planner", "scene", "noise", "first", "key"}
    assert record["config"]["planner"]["num_samples"] == 3
    assert record["versions"]["jax"] == jax.__version__
    np.testing.assert_allclose(record["config"]["first"]["position"], [0.8, 0.9, 2.2], atol=1e-6)


def test_the_cloud_reads_back_in_other_programs(finished):
    episode, folder = finished
    points, normals = episode.cloud.to_numpy()
    vertices = PlyData.read(folder / "cloud.ply")["vertex"]
    np.testing.assert_array_equal(np.stack([vertices[name] for name in ("x", "y", "z")], axis=1), points)
    np.testing.assert_array_equal(np.stack([vertices[name] for name in ("nx", "ny", "nz")], axis=1), normals)
    np.testing.assert_array_equal(np.asarray(trimesh.load(folder / "cloud.ply").vertices, np.float32), points)
    assert len(points) == int(episode.cloud.count) > 64


def test_saving_afterwards_writes_what_a_run_into_the_folder_writes(finished, tmp_path):
    episode, folder = finished
    episode.save(tmp_path / "saved")
    assert contents(tmp_path / "saved") == contents(folder)
    assert set(contents(folder)) == {"episode.json", "cloud.ply", *(f"view_0{i}.npz" for i in range(5))}


def test_three_views_continued_to_five_equal_five(finished, tmp_path):
    _, folder = finished
    run(tmp_path / "run", views=3)
    assert len(contents(tmp_path / "run")) == 5
    episode = run(tmp_path / "run", views=5)
    assert contents(tmp_path / "run") == contents(folder)
    ends = [(each.views, state_after(each)) for each in (episode, finished[0])]
    for a, b in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_array_equal(a, b)
    assert ends[0][1].seen_empty.shape == (24, 24, 24)


def test_a_finished_run_is_read_not_computed(finished, monkeypatch):
    before = contents(finished[1])
    monkeypatch.setattr(Planner, "choose", lambda *_: pytest.fail("a finished view was chosen again"))
    monkeypatch.setattr("jaxnbv.episode.observe_scene", lambda *_: pytest.fail("a finished view was scanned again"))
    run(finished[1], views=5)
    assert contents(finished[1]) == before


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"planner": planner_of(num_samples=4)}, r"planner\.num_samples: 3 there, 4 now"),
        ({"planner": planner_of(FarthestView(12))}, r"planner\.search\.type: DiscreteSearch there"),
        ({"noise": SensorNoise(0.03)}, r"noise\.points: 0\.01 there, 0\.03 now"),
        ({"key": jax.random.key(9)}, r"key\.data: \[0, 0\] there, \[0, 9\] now"),
        ({"first": look_at((0.8, 0.9, 2.3))}, r"first\.position"),
    ],
)
def test_a_folder_of_another_configuration_is_refused(finished, change, named):
    before = contents(finished[1])
    with pytest.raises(ValueError, match=r"another episode.*" + named + r".*Choose another folder"):
        run(finished[1], **change)
    assert contents(finished[1]) == before


def test_a_folder_with_other_files_is_refused(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(ValueError, match=r"holds other files \(thesis\.tex\): choose an empty folder"):
        run(tmp_path)
    assert contents(tmp_path) == {"thesis.tex": b"years of work"}


@pytest.mark.parametrize("text", ["", "{", "[]", "7", '{"versions": {}}', "\x80\xff"])
def test_a_corrupt_record_is_refused(tmp_path, text):
    (tmp_path / "episode.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match=r"episode\.json is not an episode's record.*choose another output folder"):
        run(tmp_path)


def test_leftover_parts_do_not_matter(finished, tmp_path):
    for name in (".0123456789abcdef.partial", ".00000000000000ff.partial"):
        (tmp_path / name).write_bytes(b"half a fi")
    # Not one of ours, and so not touched.
    (tmp_path / "mine.partial").write_bytes(b"half a thesis")
    run(tmp_path, views=5)
    assert contents(tmp_path) == contents(finished[1]) | {"mine.partial": b"half a thesis"}


SCRIPT = """
import os, sys, time
from pathlib import Path
import jaxnbv.episode, jaxnbv.files
from test_storage import run

folder, stage, view = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])

def stall_at(module, name, moment):
    original, calls = getattr(module, name), [0]
    def replacement(*arguments):
        calls[0] += 1
        if moment(calls[0]):
            folder.with_suffix(".stalled").touch()
            time.sleep(600)
        return original(*arguments)
    setattr(module, name, replacement)

done = len(list(folder.glob("view_*.npz")))
if stage == "scan":
    stall_at(jaxnbv.episode, "observe_scene", lambda call: done + call == view + 1)
if stage == "write":
    record = 0 if (folder / "episode.json").exists() else 1
    stall_at(jaxnbv.files.os, "fsync", lambda call: done + call == view + 1 + record)
run(folder, views=5)
"""


def start(folder, stage="none", view=0):
    command = [sys.executable, "-c", SCRIPT, str(folder), stage, str(view)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")]),
        "JAX_COMPILATION_CACHE_DIR": str(folder.with_suffix(".cache")),
        # The promise is about programs as users run them.
        "XLA_FLAGS": "",
    }
    return subprocess.Popen(command, env=environment, stderr=subprocess.PIPE)


def kill_once(process, reached):
    """SIGKILL as soon as `reached()`; the process must still have been running."""
    deadline = time.monotonic() + 300
    while not reached():
        if process.poll() is not None:
            pytest.fail(f"it ended before it could be killed: {process.stderr.read().decode()}")
        assert time.monotonic() < deadline
        time.sleep(0.005)
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL


def test_killed_at_any_moment_and_started_again_it_ends_with_the_same_files(tmp_path):
    """Once when the first view appears, once half way through writing the second, once while the third is scanned."""
    folder, stalled = tmp_path / "killed", tmp_path / "killed.stalled"
    uninterrupted = start(tmp_path / "whole")
    kill_once(start(folder), (folder / "view_00.npz").exists)
    assert "cloud.ply" not in contents(folder)

    kill_once(start(folder, "write", 1), stalled.exists)
    assert list(folder.glob(".*.partial"))
    assert not (folder / "view_01.npz").exists()
    stalled.unlink()

    kill_once(start(folder, "scan", 2), stalled.exists)
    assert (folder / "view_01.npz").exists()
    assert not (folder / "view_02.npz").exists()

    process = start(folder)
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    assert uninterrupted.wait(timeout=300) == 0
    assert contents(folder) == contents(tmp_path / "whole")


def test_fewer_views_than_the_folder_holds_are_refused(finished):
    with pytest.raises(ValueError, match=r"asked for 1 views but .* already holds 5"):
        run(finished[1], views=1)


@pytest.mark.parametrize("size", [0, 100, 3000])
def test_a_damaged_view_is_refused_by_name(finished, tmp_path, size):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    (folder / "view_01.npz").write_bytes((folder / "view_01.npz").read_bytes()[:size])
    with pytest.raises(ValueError, match=r"view_01.npz is damaged .* delete it"):
        run(folder, views=5)


def test_a_shorter_episode_is_not_saved_over_a_longer_one(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    episode = finished[0]
    shorter = eqx.tree_at(lambda e: e.views, episode, episode.views[:2])
    with pytest.raises(ValueError, match="already holds 5 views"):
        shorter.save(folder)


def test_an_output_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(ValueError, match="File exists"):
        run(tmp_path / "notes")


def test_other_versions_are_told_of(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    record = json.loads((folder / "episode.json").read_text())
    record["versions"]["jax"] = "0.0.1"
    (folder / "episode.json").write_text(json.dumps(record))
    with pytest.warns(UserWarning, match=r"other versions \(jax: 0.0.1 there"):
        run(folder, views=5)


def config_of(episode):
    return describe(BASE | {"planner": episode.planner})


def test_a_first_view_that_fails_does_not_bind_its_folder(tmp_path, finished):
    with pytest.raises(InputError, match="the first scan is empty"):
        run(tmp_path, first=look_at((0.0, 0.0, 2.5), (0.0, 0.0, 9.0)))
    assert contents(tmp_path) == {}
    run(tmp_path, views=5)
    assert contents(tmp_path) == contents(finished[1])


def test_a_record_without_views_binds_nobody(tmp_path, finished):
    """A run that was killed between the two files."""
    run(tmp_path, views=1, key=jax.random.key(9))
    (tmp_path / "view_00.npz").unlink()
    (tmp_path / "cloud.ply").unlink()
    run(tmp_path, views=5)
    assert contents(tmp_path) == contents(finished[1])


def rewritten(file, changes, without=()):
    with np.load(file) as saved:
        arrays = {name: saved[name] for name in saved.files if name not in without}
    np.savez_compressed(file, **(arrays | changes))


def test_a_view_that_is_not_what_it_was_is_refused(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    file, whole = folder / "view_01.npz", (folder / "view_01.npz").read_bytes()

    def problem():
        with pytest.raises(InputError, match=r"view_01\.npz is damaged .* delete it") as error:
            run(folder, views=5)
        file.write_bytes(whole)
        return str(error.value)

    shutil.copy(folder / "view_02.npz", file)
    assert "it is view 2" in problem()
    rewritten(file, {"value": np.float32(1.0)})
    assert "checksum" in problem()
    rewritten(file, {}, ["missed"])
    assert "checksum" in problem()
    of_format_1 = ("format", "index", "sha256")
    for name, array in (
        ("mask", np.ones(63, bool)),
        ("points", np.zeros((64, 2), np.float32)),
        ("normals", np.zeros((64, 3), int)),
        ("values", np.zeros(11, np.float32)),
        ("rotation", np.zeros((3, 3, 1), np.float32)),
        ("missed", np.array(["x"] * 64)),
    ):
        rewritten(file, {name: array}, of_format_1)
        # Where two lengths should be one, the later array is named.
        assert f"its {'candidate_rotations' if name == 'values' else name} is " in problem()


def test_no_turned_bit_of_a_view_passes(finished, tmp_path):
    """Any one bit: the file is refused by name, or its arrays are the same (bits that mean nothing)."""
    episode, folder = finished
    config = config_of(episode)
    copy = shutil.copytree(folder, tmp_path / "copy")
    whole, expected = (folder / "view_01.npz").read_bytes(), EpisodeFolder(folder, config).read_views()[1]
    ends = whole.index(b"PK\x01\x02")
    # The first header, all of the directory, and a sample of the rest.
    places = [*range(60), *range(ends, len(whole), 7), *np.random.default_rng(0).integers(0, len(whole), 150)]
    refused = 0
    for place in places:
        turned = bytearray(whole)
        turned[place] ^= 1 << (place % 8)
        (copy / "view_01.npz").write_bytes(turned)
        try:
            views = EpisodeFolder(copy, config).read_views()
        except InputError as error:
            refused += "view_01.npz is damaged" in str(error)
            continue
        for a, b in zip(jax.tree.leaves(views[1]), jax.tree.leaves(expected), strict=True):
            np.testing.assert_array_equal(a, b)
    assert refused > len(places) / 2


def test_an_episode_of_a_later_format_is_refused(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    record = json.loads((folder / "episode.json").read_text())
    (folder / "episode.json").write_text(json.dumps(record | {"format": 3}))
    with pytest.raises(InputError, match=r"episode\.json is of format 3; .* install a newer one"):
        run(folder, views=5)
    (folder / "episode.json").write_text(json.dumps(record))
    rewritten(folder / "view_01.npz", {"format": np.asarray(3)})
    with pytest.raises(InputError, match=r"view_01\.npz is of format 3; .* install a newer one"):
        run(folder, views=5)


def test_one_process_writes_at_a_time(finished, tmp_path):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    script = (
        "import sys, time\nfrom pathlib import Path\nfrom jaxnbv.folders import ResultFolder\n"
        "with ResultFolder(sys.argv[1], 'episode.json', 'nothing_*', {}, 'episode').writing():\n"
        "    print('holding', flush=True)\n    sys.stdin.read()\n"
    )
    holder = subprocess.Popen([sys.executable, "-c", script, folder], stdin=-1, stdout=-1, text=True)
    assert holder.stdout.readline() == "holding\n"
    with pytest.raises(InputError, match=rf"is being written by process {holder.pid} on .*: wait until it ends"):
        run(folder, views=5)
    holder.kill()
    holder.communicate()
    run(folder, views=5)
    assert contents(folder) == contents(finished[1])


def test_a_name_that_is_too_long_is_told(tmp_path):
    with pytest.raises(InputError, match=r"cannot make the output folder .*File name too long"):
        run(tmp_path / ("n" * 300))


def test_more_cores_than_before_are_told_of(finished, tmp_path, monkeypatch):
    folder = shutil.copytree(finished[1], tmp_path / "copy")
    monkeypatch.setattr("jaxnbv.folders.loky.cpu_count", lambda: 64)
    with pytest.warns(UserWarning, match=r"cores: \d+ there, 64 now"):
        run(folder, views=5)
