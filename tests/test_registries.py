"""Registries of the command line: everything that they name exists and has the right kind. A study in a user's package
is found too."""

import inspect
import os

import jax
import numpy as np
import pytest
from commands import run_process

from jaxnbv.cli.play import search_of, stop_rule_of
from jaxnbv.cli.registry import SEARCHES, STOPS
from jaxnbv.cli.tasks import TASKS
from jaxnbv.planning.stopping import StopRule
from jaxnbv.search import Search
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import studies


@pytest.mark.parametrize("name", TASKS)
def test_a_task_has_a_sensor_and_ends_by_rules_that_exist(name):
    task = TASKS[name]
    assert task.setting().radius > 1.5
    assert (stop_rule_of(task.until) is not None) == bool(task.until)


@pytest.mark.parametrize("name", STOPS)
def test_a_rule_is_made_of_a_number(name):
    assert isinstance(stop_rule_of([f"{name}=0.5" if name != "parts-found" else "parts-found=5"]), StopRule)


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_stands_at_the_sensors_distance_with_as_many_candidates(name):
    search = search_of(name, 2.2, 24)
    assert isinstance(search, Search)
    if search.candidates is not None:
        poses = search.candidates.poses()
    else:
        poses = search.space.candidates(24, jax.random.key(0))
    distance = np.linalg.norm(poses.position, axis=1)
    assert len(distance) == 24
    assert distance.mean() == pytest.approx(2.2, abs=0.1)


@pytest.mark.parametrize("name", studies())
def test_a_study_is_declared_in_full(name):
    entry = studies()[name]
    study = entry.load()
    assert issubclass(study, Study)
    assert study.reference in study.methods
    names = [measure.name for measure in study.measures]
    assert len({*names}) == len(names)
    # Settings, and further options of `configured`.
    options = {*inspect.signature(study).parameters, *inspect.signature(study.configured).parameters}
    assert {*entry.options} <= options - {"model", "views", "quick", "options"}
    assert {*study.quick, *study.paper} <= {*inspect.signature(study).parameters}
    seeds = [other.load().seed for other in studies().values()]
    assert len({*seeds}) == len(seeds)


OWN_PACKAGE = {
    "dents-1.0.dist-info/METADATA": "Metadata-Version: 2.1\nName: dents\nVersion: 1.0\n",
    "dents-1.0.dist-info/entry_points.txt": "[jaxnbv.studies]\ndents = dents.entry:DENTS\nlost = dents.nothing:LOST\n",
    "dents/__init__.py": "",
    "dents/entry.py": """
import sys
from typing import Annotated

import typer

from jaxnbv.studies.registry import Entry

assert "jax" not in sys.modules
SIZE = Annotated[float | None, typer.Option(help="Radius of the dents.")]
DENTS = Entry("dents.study:DentStudy", "How much of a dented ball is seen?", scenes=3, views=2, options={"size": SIZE})
""",
    "dents/study.py": """
import equinox as eqx

import jaxnbv as nbv
from jaxnbv.studies.engine.measures import Measure
from jaxnbv.studies.engine.study import Scene, Study


class DentStudy(Study):
    title, explanation, seed = "Points of dented balls", "More is better.", 3
    methods, reference = ("farthest", "random"), "farthest"
    measures = (Measure("points", "Points", lambda record, name: record["methods"][name]["points"]),)
    quick = {"num_candidates": 6, "num_samples": 2, "grid_resolution": 16, "capacity": 200}

    size: float = eqx.field(static=True, default=0.5)

    def scene(self, index):
        dent = nbv.sdf.Sphere(self.size).translate([0.0, 1.0, 0.1 * index])
        return Scene(index, f"ball {index}", nbv.SDFSurface(nbv.sdf.Sphere(1.0) - dent))

    def acquisition(self, method, scene):
        return nbv.Coverage()

    def follow(self, scene, truth, planner, episode):
        return {"points": [int(step.view.scan.count) for step in episode]}
""",
}


@pytest.fixture
def own_package(tmp_path, monkeypatch):
    """The folder of a user's installed package, which processes find too."""
    for name, text in OWN_PACKAGE.items():
        file = tmp_path / "installed" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    paths = [str(tmp_path / "installed"), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))
    return tmp_path


def test_a_study_of_an_installed_package_stands_in_the_help_and_one_that_fails_is_named(own_package):
    result = run_process("study", "--help", cwd=own_package)
    assert result.returncode == 0, result.stderr
    assert "dents How much of a dented ball is seen?" in " ".join(result.stdout.split())
    own = " ".join(run_process("study", "dents", "--help", cwd=own_package).stdout.split())
    assert "The default is 3 scenes with 2 views each." in own
    assert "Radius of the dents." in own
    assert "the study lost is left out: dents.nothing:LOST fails" in result.stderr
    assert "lost" not in result.stdout


@pytest.mark.slow
def test_a_study_of_an_installed_package_runs_here_and_in_processes(own_package):
    arguments = ("study", "dents", "--quick", "--model", "paper", "--size", "0.4", "--out", "mine")
    for more in (("--scenes", "1"), ("--scenes", "2", "--workers", "2")):
        result = run_process(*arguments, *more, cwd=own_package)
        assert result.returncode == 0, result.stderr
    assert "Points of dented balls: 2 scenes" in result.stdout
    names = {path.name for path in (own_package / "mine").iterdir()}
    assert {"scene_0000.json", "scene_0001.json", "results.csv", "chart.png"} <= names
    assert '"size": 0.4' in (own_package / "mine" / "study.json").read_text()
    report = run_process("report", "mine", cwd=own_package)
    assert report.returncode == 0, report.stderr
    assert "Points of dented balls" in (own_package / "mine" / "report.html").read_text()
