"""How a scene of a study is run with every method, and how a method's views are seen again."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from jaxnbv.checks import InputError, check_type, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.observations import Observations
from jaxnbv.planning.planner import Planner
from jaxnbv.storage.rebuilding import read_config
from jaxnbv.studies.engine.episodes import episode_record, poses_of, seen_again
from jaxnbv.studies.engine.measures import KNOWN, WITHOUT_BANK, Record
from jaxnbv.studies.engine.records import RecordFolder, read_records
from jaxnbv.studies.engine.study import Scene, Study

# A method of one's own: the planner of a scene.
Factory: TypeAlias = Callable[[Study, Scene], Planner]


def run_scene(
    study: Study, index: int, methods: Sequence[str] | None = None, own: Mapping[str, Factory] | None = None
) -> Record:
    """One scene with every method: the record that tables and figures are made of.

    All methods share the first view, a random one of the candidates that show enough, the sensor's noise and the
    prior's samples at each view.

    - `methods`: some of the study's, by default all; `own`: further ones, and what makes their planners.

    **Raises:** `ValueError` for an unknown method, as `Study.scene` does, if no candidate shows enough, or if one of
    `own` makes no planner of so many views.
    """
    names = study.methods if methods is None else methods_of(type(study), methods, KNOWN)
    start = time.perf_counter()
    scene = study.scene(index)
    planners = {name: _own_planner(study, scene, name, make) for name, make in (own or {}).items()}
    first, truth = study.first_view(scene), study.truth(scene)
    sensor, pose = study.sensor(scene), study.candidates.poses()[first]
    record = {"scene": index, **study.facts(scene, truth, first), "first": first, "study_views": study.views}
    record["methods"] = {}
    for method, planner in ({name: study.planner(name, scene) for name in names} | planners).items():
        follow = functools.partial(study.follow, scene, truth, planner)
        keys = study.episode_keys(method, scene)
        runs = [episode_record(planner, sensor, pose, key, study.camera, study.views, follow) for key in keys]
        record["methods"][method] = study.joined(runs)
    return record | {"seconds": time.perf_counter() - start}


def load_study(folder: str | Path) -> tuple[Study, list[Record]]:
    """The study of a folder with its settings, and its records.

    **Raises:** `ValueError` if there is none, or if it or a record is damaged.
    """
    # Which methods were run, and those of a user, are no part of the study.
    config = read_config(folder, "study", RecordFolder.format, {"methods": None, "own": None})
    return config["study"], read_records(folder)


def methods_of(study: type[Study], names: Sequence[str] | None, model: str) -> tuple[str, ...]:
    """The methods of these names, in order; by default all of a study's, and where shapes are known those of
    `Study.without_bank`.

    **Raises:** `ValueError` for an unknown method.
    """
    twice = [name for name in study.without_bank if name in study.methods] if model == KNOWN else []
    again = tuple(f"{name}{WITHOUT_BANK}" for name in twice)
    if names is None:
        return (*study.methods, *again)
    known = (*study.methods, *again, *study.further)
    unknown = sorted({*names} - {*known})
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(known)}")
    return tuple(name for name in known if name in names)


def _own_planner(study: Study, scene: Scene, name: str, make: Factory) -> Planner:
    try:
        planner = make(study, scene)
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
        raise InputError(f"the method {name} fails on scene {scene.index} ({problem})") from error
    check_type(planner, Planner, f"what the method {name} makes")
    require(
        planner.max_views >= study.views,
        f"the method {name} makes a planner of {planner.max_views} views, but the study has {study.views}: give "
        f"Planner(max_views={study.views})",
    )
    return planner


def replay(study: Study, scene: Scene, run: Record) -> list[tuple[PointCloud, Observations]]:
    """Each scan of a method, and the observations after it, made again from the poses of its record."""
    planner, sensor, key = (
        study.planner(study.methods[0], scene),
        study.sensor(scene),
        study.key(scene.index, "episode"),
    )
    return seen_again(planner, sensor, poses_of(run), key, study.camera)
