"""The registries of the command line: everything that they name is there, and is what it is taken for."""

import inspect

import jax
import numpy as np
import pytest

from jaxnbv.cli.play import rule, search_of
from jaxnbv.cli.registry import SEARCHES, STOPS, resolve
from jaxnbv.cli.tasks import TASKS
from jaxnbv.planning.stopping import StopRule
from jaxnbv.search import Search
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import STUDIES


@pytest.mark.parametrize("name", TASKS)
def test_a_task_has_a_sensor_and_ends_by_rules_that_exist(name):
    task = TASKS[name]
    assert task.setting().radius > 1.5
    assert (rule(task.until) is not None) == bool(task.until)


@pytest.mark.parametrize("name", STOPS)
def test_a_rule_is_made_of_a_number(name):
    assert isinstance(rule([f"{name}=0.5" if name != "found" else "found=5"]), StopRule)


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


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_is_declared_in_full(name):
    entry = STUDIES[name]
    study = resolve(entry.study)
    assert issubclass(study, Study)
    assert study.reference in study.methods
    names = [measure.name for measure in study.measures]
    assert len({*names}) == len(names)
    # Settings, or what else it is configured by.
    taken = {*inspect.signature(study).parameters, *inspect.signature(study.configured).parameters}
    assert {*entry.options} <= taken - {"model", "views", "quick", "options"}
    assert {*study.quick} <= {*inspect.signature(study).parameters}
    seeds = [resolve(other.study).seed for other in STUDIES.values()]
    assert len({*seeds}) == len(seeds)
