"""The registries of the command line: everything that they name is there, and is what it is taken for."""

import inspect

import jax
import numpy as np
import pytest

from jaxnbv.cli.play import RULES, search_of
from jaxnbv.cli.registry import SEARCHES, STOPS, TASKS
from jaxnbv.cli.tasks import COMMAND_TASKS
from jaxnbv.search import Search
from jaxnbv.studies.engine.study import Study
from jaxnbv.studies.registry import studies


@pytest.mark.parametrize("name", TASKS)
def test_a_task_has_a_sensor_and_requires_what_it_takes(name):
    entry = TASKS[name]
    assert COMMAND_TASKS[name].setting.radius > 1.5
    assert {*entry.requires, *entry.options} <= {"network", "category", "source"}


def test_every_task_and_rule_is_there():
    assert COMMAND_TASKS.keys() == TASKS.keys()
    assert RULES.keys() == STOPS.keys()


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
    # Settings, or what else it is configured by.
    taken = {*inspect.signature(study).parameters, *inspect.signature(study.configured).parameters}
    assert {*entry.options} <= taken - {"model", "views", "quick", "options"}
    assert {*study.quick} <= {*inspect.signature(study).parameters}
    seeds = [other.load().seed for other in studies().values()]
    assert len({*seeds}) == len(seeds)
