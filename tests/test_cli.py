"""The command line as a user calls it: one call of each kind in its own process, and the others in this process."""

import gc
import json
import os
import re
import subprocess
import sys
import threading
import time
import types
import warnings
import weakref
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import trimesh
import typer
from commands import run_command, run_process

from jaxnbv.cli import app, play
from jaxnbv.cli.tasks import TASKS
from jaxnbv.planning.loop import Step
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.studies.registry import studies
from jaxnbv.viz import Sketches


def check_demo(folder, result, name):
    """Check a demo of two views, and return its folder."""
    assert result.returncode == 0, result.stderr
    out = folder / "runs" / name
    names = {path.name for path in out.iterdir()}
    assert {"episode.json", "view_00.npz", "view_01.npz", "cloud.ply", "report.html"} <= names
    assert "view 2" in result.stdout
    # Probabilities before and after: the likeliest three on a line after each view.
    lines = [line for line in result.stdout.splitlines() if line.count(" %") >= 3]
    assert [line.count("(was ") for line in lines] == [0, 3]
    assert max(map(len, result.stdout.splitlines())) <= 100
    assert "\r" not in result.stdout + result.stderr
    assert str(out.relative_to(folder) / "report.html") in result.stdout
    return out


def test_the_demo_leaves_an_episode_a_rival_and_a_report(tmp_path, monkeypatch):
    """This search needs no samples, and the first view is one of a few. The slow test has the default settings."""
    monkeypatch.setattr("jaxnbv.search.candidates.sphere_candidates", lambda count: sphere_candidates(12))
    result = run_command("demo", "--quick", "--model", "paper", "--search", "random", "--views", "2", cwd=tmp_path)
    out = check_demo(tmp_path, result, "truck-cross-entropy-random-paper-seed2")
    assert re.search(r"(?m)^race     .*[Ff]arthest view", result.stdout), result.stdout
    assert (out / "farthest" / "view_01.npz").exists()
    config = json.loads((out / "episode.json").read_text())["config"]
    assert config["planner"]["search"]["type"].endswith(":RandomView")


@pytest.mark.slow
def test_the_demo_runs_in_its_own_process_and_the_same_command_continues_it(tmp_path):
    options = ("demo", "--quick", "--known", "none")
    name = "truck-cross-entropy-halving-seed2"
    out = check_demo(tmp_path, run_process(*options, "--views", "2", cwd=tmp_path), name)
    before = {path.name: path.read_bytes() for path in out.glob("view_*.npz")}
    result = run_command(*options, "--views", "3", "--until", "never", "--no-report", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (out / "view_02.npz").exists()
    assert all((out / name).read_bytes() == content for name, content in before.items())


def test_an_option_for_several_folders_takes_all_words_up_to_the_next():
    words = ["--join", "a", "b", "--quick", "--join", "c", "--workers", "2"]
    values = typer.main.get_command(app).commands["study"].commands["pyramid"].make_context("pyramid", words).params
    assert values["join"] == [Path("a"), Path("b"), Path("c")]
    assert (values["quick"], values["workers"]) == (True, 2)


def test_the_help_of_studies_is_an_overview_and_that_of_a_study_has_its_options_alone(tmp_path):
    overview = run_command("study", "--help", cwd=tmp_path).stdout
    lines = {words[1]: line for line in overview.splitlines() if len(words := line.split()) > 2}
    assert all(lines[name].rstrip("│ ").endswith("?") for name in studies())
    assert "--scenes" not in overview
    assert len(overview.splitlines()) < 35
    own = {name: run_command("study", name, "--help", cwd=tmp_path).stdout for name in ("pyramid", "recorded")}
    assert all("--capacity" in text for text in own.values())
    assert ["--framing" in text for text in own.values()] == [True, False]
    assert ["--depth-scale" in text for text in own.values()] == [False, True]


def test_equal_warnings_are_printed_once_with_their_number(tmp_path, monkeypatch):
    def run_episode(*arguments, **settings):
        for place in ("here", "there", "here", "here"):
            warnings.warn(f"the mesh is {place}", stacklevel=2)
            # Libraries do this, and then Python's own filter prints every warning again.
            with warnings.catch_warnings():
                warnings.simplefilter("always")

    monkeypatch.setattr("jaxnbv.cli.play.run_episode", run_episode)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = run_command("demo", "--task", "coverage", cwd=tmp_path)
    lines = [line for line in result.stderr.splitlines() if "the mesh is" in line]
    assert lines == [
        "warning: the mesh is here",
        "warning: the mesh is there",
        "warning, 3 times in all: the mesh is here",
    ]


def test_a_rule_ends_it_and_says_what_is_saved(tmp_path):
    """No other candidate is within a travel of 0.1."""
    arguments = ("demo", "--task", "coverage", "--quick", "--views", "3", "--search", "farthest", "--no-report")
    rules = ("--until", "travel=0.1", "--until", "seconds=1e6")
    result = run_command(*arguments, *rules, "--out", "mine", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "enough   after view 1: the next view would cost" in result.stdout
    assert "Views saved: 2 of 3" in result.stdout
    assert len(list((tmp_path / "mine").glob("view_*.npz"))) == 1
    result = run_command(*arguments, "--until", "never", "--out", "mine", cwd=tmp_path)
    assert len(list((tmp_path / "mine").glob("view_*.npz"))) == 3
    assert "enough" not in result.stdout


@pytest.mark.parametrize(
    ("search", "model"),
    [
        ("farthest", "screened"),
        pytest.param("random", "paper", marks=pytest.mark.slow),
        ("uncertainty", "paper"),
        pytest.param("gradient-constrained", "screened", marks=pytest.mark.slow),
    ],
)
def test_run_takes_a_mesh_each_search_and_each_model(search, model, tmp_path):
    trimesh.creation.torus(1.0, 0.4).export(tmp_path / "ring.ply")
    named = () if model == "screened" else ("--model", model)
    arguments = ("run", "ring.ply", "--quick", "--views", "2", "--search", search, "--out", "mine", "--no-report")
    result = run_command(*arguments, *named, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    config = json.loads((tmp_path / "mine" / "episode.json").read_text())["config"]
    sampler = config["planner"]["sampler"]
    assert sampler["model"]["type"].partition(":")[2] == {"screened": "ScreenedSPSR", "paper": "GeometricSPSR"}[model]
    assert (sampler["carving"] is None) == (model == "paper")
    with np.load(tmp_path / "mine" / "view_01.npz") as view:
        positions, values = view["proposal.candidates.position"], view["proposal.values"]
        if "proposal.trajectories.values" in view:
            positions = np.concatenate([positions, view["proposal.trajectories.poses.position"].reshape(-1, 3)])
            values = np.concatenate([values, view["proposal.trajectories.values"].ravel()])
        chosen = np.flatnonzero((positions == view["pose.position"]).all(axis=1))
        assert values[chosen].max() == values.max() == view["proposal.value"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "absent.obj"), ("absent.obj",)),
        (("demo", "--task", "coverage", "--views", "0"), ("0 views", "at least one")),
        (("demo", "--task", "coverage", "--first", "1", "2"), ("--first", "3 arguments")),
        (("demo", "--task", "coverage", "--first", "0", "0", "0"), ("target",)),
        (("demo", "--task", "coverage", "--first", "0", "0", "9", "--noise", "-1"), ("-1", "negative")),
        (("demo", "--task", "coverage", "--first", "0.55", "-0.84", "0"), ("(0.55, -0.84, 0.0)", "inside")),
        (("run", "ball.obj", "--first", "0.3", "-1", "0.2"), ("(0.3, -1.0, 0.2)", "inside the object", "outside")),
        (("demo", "--task", "coverage", "--first", "0", "0", "1e30"), ("position", "1.e+30")),
        (("demo", "--scene", "99999999999999"), ("--scene", "2147483647")),
        (("run", "flat.obj"), ("flat.obj", "area")),
        (("run", "broken.glb"), ("broken.glb", "cannot read")),
        (("demo", "--task", "coverage", "--out", "flat.obj"), ("flat.obj", "File exists")),
        (("demo", "--task", "coverage", "--until", "surely=3"), ("'surely=3'", "sure", "never")),
        (("demo", "--task", "coverage", "--until", "sure"), ("'sure'", "a number")),
        (("demo", "--task", "coverage", "--until", "sure=0.9"), ("NewSurface", "classifier")),
        (("demo", "--vews", "3"), ("--vews", "--views")),
        (("demo", "--search", "halvng"), ("halvng", "discrete", "Did you mean 'halving'?")),
        (("demo", "--model", "paper", "--known", "truck"), ("--known truck", "no known shapes", "--model screened")),
        (("study", "pyramyd"), ("pyramyd", "Did you mean 'pyramid'?")),
        (("study", "recorded"), ("FOLDER",)),
        (("study", "recorded", "occupied", "--candidates", "9"), ("--candidates 9", "frames of the recording")),
        (("study", "pyramid", "--quick", "--settings", "paper"), ("--quick and --settings paper",)),
        (("demo", "--task", "coverage", "--out", "occupied"), ("occupied", "other files")),
        (("run", "ball.obj", "--task", "parts"), ("--category",)),
        (("run", "ball.obj", "--task", "parts", "--category", "teapot"), ("teapot", "mug")),
        (("run", "ball.obj", "--task", "parts", "--category", "knife"), ("knife", "--network")),
        (("run", "ball.obj", "--task", "heat", "--search", "gradient-2dof"), ("ColdestPoint", "DiscreteSearch")),
        (("run", "ball.obj", "--source", "1", "0", "0"), ("--source", "heat")),
        (("run", "ball.obj", "--task", "cross-entropy"), ("cross-entropy", "--network")),
        (("study", "parts", "--methods", "best"), ("best", "gradient-2dof")),
        (("study", "parts", "--method", "broken_module:it"), ("broken_module:it", "ZeroDivisionError")),
        (("study", "parts", "--method", "leaving:it"), ("leaving:it", "SystemExit")),
        (("study", "parts", "--method", "halved:it"), ("halved:it", "SyntaxError")),
        (("study", "parts", "--method", ".mine:it"), (".mine:it", "cannot be found")),
        (("study", "reconstruction", "--meshes", "occupied"), ("occupied", "no mesh")),
        (("study", "pyramid", "--quick", "--cluster", "here"), ("here", "dask scheduler")),
        (("study", "pyramid", "--quick", "--join", "occupied", "lost"), ("occupied", "no records of this study")),
    ],
)
def test_bad_input_is_one_line_that_names_the_value_and_the_remedy(arguments, words, tmp_path):
    for name, text in {"broken_module": "1 / 0", "leaving": "import sys\nsys.exit(5)", "halved": "def ("}.items():
        (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (tmp_path / "broken.glb").write_bytes(b"glTF and no more")
    trimesh.creation.icosphere(2).export(tmp_path / "ball.obj")
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "thesis.tex").write_text("mine")
    result = run_command(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert all(word in result.stderr for word in words), result.stderr


def test_a_device_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "rocm")
    result = run_process("demo", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("error: JAX_PLATFORMS is 'rocm', but JAX finds no such device here")


def test_a_command_of_another_package_stands_beside_ours(tmp_path, monkeypatch):
    """A command that cannot be imported, or has the name of ours, does not affect the others."""
    (tmp_path / "toy.py").write_text(
        'def greet(who: str = "you") -> None:\n    """Greets."""\n    print("hello", who)\n'
    )
    (tmp_path / "toy_broken.py").write_text("1 / 0")
    folder = tmp_path / "toy-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    points = "greet = toy:greet\nview = toy:greet\nbreak = toy_broken:it\n"
    (folder / "entry_points.txt").write_text(f"[jaxnbv.commands]\n{points}")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    result = run_process("--help", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "Greets." in result.stdout
    assert "Look at a run or a session in the browser" in result.stdout
    (line,) = result.stderr.splitlines()
    assert line.startswith("warning: toy has no command break (ZeroDivisionError")
    assert run_process("greet", "--who", "me", cwd=tmp_path).stdout == "hello me\n"


RACE = """
import sys, threading, types
from jaxnbv.cli import main, play
from jaxnbv.cli.tasks import TASKS

racing = threading.Event()

def simulate(*arguments, each=None, **settings):
    if each is None:
        racing.set()
        threading.Event().wait()
    each(types.SimpleNamespace(view="view 1"))
    assert racing.wait(300)
    raise KeyboardInterrupt

play.simulate, play.ViewPrinter = simulate, lambda planner: print
TASKS["coverage"].until = ("seconds=1e6",)
sys.argv = ["jaxnbv", "demo", "--task", "coverage", "--no-report"]
main()
"""


def test_an_interrupt_ends_the_process_while_a_rival_still_runs(tmp_path):
    """The rival would never end."""
    script = [sys.executable, "-c", RACE]
    result = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert result.returncode == 130, result.stderr
    assert "view 1" in result.stdout


class Drawings(Sketches):
    """Sketches that block at the last view."""

    may_end = threading.Event()

    def add(self, step):
        assert step.view < 3 or self.may_end.wait(300)


def test_no_posterior_waits_for_a_rival_or_for_an_earlier_drawing(tmp_path, monkeypatch):
    references = []

    def simulate(*arguments, each=None, **settings):
        episode = types.SimpleNamespace(stop_reason=None, views=())
        if each is None:
            assert Drawings.may_end.wait(300)
            return episode
        for view in (1, 2, 3):
            step = mock.Mock(spec=Step, view=view, posterior={1, 2, 3})
            references.append(weakref.ref(step.posterior))
            each(step)
            del step
        # The thread of a drawing ends after its result is available.
        until = time.monotonic() + 60
        while any(one() for one in references[:2]) and time.monotonic() < until:
            gc.collect()
            time.sleep(0.01)
        references[:] = [one() is not None for one in references]
        Drawings.may_end.set()
        return episode

    monkeypatch.setattr(TASKS["coverage"], "until", ("seconds=1e6",))
    changes = {"simulate": simulate, "ViewPrinter": lambda planner: print, "rival_text": lambda *episodes: "a race"}
    monkeypatch.setattr(play.viz, "Sketches", Drawings)
    monkeypatch.setattr(play.viz, "write_report", lambda *arguments, **settings: "report.html")
    with mock.patch.multiple(play, **changes):
        result = run_command("demo", "--task", "coverage", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "a race" in result.stdout
    assert references == [False, False, True]


@pytest.mark.slow
def test_warm_up_compiles_for_a_camera(tmp_path):
    camera = ["--intrinsics", "40", "40", "32", "24", "--size", "48", "64"]
    result = run_command("warm-up", *camera, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert re.search(r"[1-9]\d+ programs in \d+ s, kept in ", result.stdout)


@pytest.mark.slow
def test_a_published_checkpoint_classifies_a_mesh(tmp_path, shared):
    trimesh.creation.torus(1.0, 0.4).export(tmp_path / "ring.ply")
    network = str(shared / "reference" / "pointnet2_cls_ssg.pth")
    arguments = ("--task", "mixed", "--network", network, "--quick", "--views", "2", "--no-report")
    result = run_command("run", "ring.ply", *arguments, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "(was " in result.stdout


@pytest.mark.slow
def test_the_study_writes_tables_and_figures_and_continues(tmp_path):
    arguments = ("study", "pyramid", "--quick", "--views", "2", "--framing", "whole", "--out", "mine")
    some = ("--methods", "farthest,oracle")
    result = run_command(*arguments, *some, "--scenes", "1", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "not the full study" in result.stdout
    folder = tmp_path / "mine" / "whole"
    first = (folder / "scene_0000.json").read_bytes()
    assert {"results.csv", "chart.png", "scene_0000.png"} <= {path.name for path in folder.iterdir()}
    result = run_command(*arguments, *some, "--scenes", "2", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert (folder / "scene_0000.json").read_bytes() == first
    assert (folder / "scene_0001.json").exists()
    result = run_command(*arguments, "--methods", "farthest,best", cwd=tmp_path)
    assert result.returncode == 2
    assert "best" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["heat", "reconstruction"])
def test_each_study_writes_tables_figures_and_pictures(name, tmp_path):
    sizes = ("--quick", "--scenes", "1", "--views", "2", "--methods", "farthest,random")
    result = run_command("study", name, *sizes, "--out", "it", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "not the full study" in result.stdout
    written = {path.name for path in (tmp_path / "it").iterdir()}
    assert {"study.json", "scene_0000.json", "results.csv", "chart.png", "scene_0000.png"} <= written


@pytest.mark.slow
def test_the_demo_of_a_task_tells_what_was_found(tmp_path):
    setting = ("--task", "parts", "--known", "parts", "--scene", "7", "--quick", "--views", "2", "--search", "farthest")
    result = run_command("demo", *setting, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("wheel") == 2
    (report,) = tmp_path.rglob("report.html")
    assert "Points predicted of each part" in report.read_text()
