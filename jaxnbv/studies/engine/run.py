"""Functions that run a study's methods on a scene, load stored studies, and recompute scans."""

import functools
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

from jaxnbv.checks import InputError, check_type, require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.observations import Observations
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.storage.rebuilding import read_config
from jaxnbv.studies.engine.episodes import episode_record, poses_of
from jaxnbv.studies.engine.measures import KNOWN, WITHOUT_BANK, Record
from jaxnbv.studies.engine.records import RecordFolder, read_records
from jaxnbv.studies.engine.study import Scene, Study

# Type of a user's method: a function that makes the planner for a scene.
Factory: TypeAlias = Callable[[Study, Scene], Planner]


def run_scene(
    study: Study, index: int, methods: Sequence[str] | None = None, own: Mapping[str, Factory] | None = None
) -> Record:
    """Run all methods on one scene and return the record, from which tables and figures are made.

    All methods share the first view (see `Study.first_view`), and the sensor noise and prior samples at each view.

    - `methods`: names of the study's methods to run; default: `Study.methods`.
    - `own`: the user's methods by name. Each is a function that makes the planner for a scene.

    **Raises:** `ValueError` whenever `Study.scene` raises it, and in these cases:

    - a method is unknown;
    - no candidate shows enough of the object;
    - a method of `own` fails, or does not return a planner for at least as many views as the study has.
    """
    names = study.methods if methods is None else methods_of(type(study), methods, KNOWN)
    start = time.perf_counter()
    scene = study.scene(index)
    planners = {name: _user_planner(study, scene, name, make) for name, make in (own or {}).items()}
    first, truth = study.first_view(scene), study.truth(scene)
    sensor, pose = study.sensor(scene), study.candidates.poses()[first]
    record = {"scene": index, **study.scene_record(scene, truth, first), "first": first, "study_views": study.views}
    record["methods"] = {}
    for method, planner in ({name: study.planner(name, scene) for name in names} | planners).items():
        follow = functools.partial(study.follow, scene, truth, planner)
        keys = study.episode_keys(method, scene)
        runs = [episode_record(planner, sensor, pose, key, study.camera, study.views, follow) for key in keys]
        record["methods"][method] = study.merge_runs(runs)
    return record | {"seconds": time.perf_counter() - start}


def load_study(folder: str | Path) -> tuple[Study, list[Record]]:
    """Load a study and its records from a folder.

    **Raises:** `ValueError` if the folder holds no study, or if the study or a record is damaged.
    """
    # Replace the names of methods by None, because they are settings of the run and not of the study.
    config = read_config(folder, "study", RecordFolder.format, {"methods": None, "own": None})
    return config["study"], read_records(folder)


def methods_of(study: type[Study], names: Sequence[str] | None, model: str) -> tuple[str, ...]:
    """Return the names of the methods to run, in the study's order.

    - `names`: the methods to run; default: `Study.methods`. With the model `known`, the default includes the methods of
      `Study.without_bank` a second time, under the name "METHOD-screened".
    - `model`: name of the surface model.

    **Raises:** `ValueError` for an unknown method.
    """
    names_without_bank = [name for name in study.without_bank if name in study.methods] if model == KNOWN else []
    screened_names = tuple(f"{name}{WITHOUT_BANK}" for name in names_without_bank)
    if names is None:
        return (*study.methods, *screened_names)
    available = (*study.methods, *screened_names, *study.extra_methods)
    unknown = sorted({*names} - {*available})
    require(not unknown, f"unknown methods: {', '.join(unknown)}; choose from {', '.join(available)}")
    return tuple(name for name in available if name in names)


def _user_planner(study: Study, scene: Scene, name: str, make: Factory) -> Planner:
    try:
        planner = make(study, scene)
    except Exception as error:
        problem = f"{type(error).__name__}: {error}"
        raise InputError(f"the method {name} fails on scene {scene.index} ({problem})") from error
    check_type(planner, Planner, f"the planner of the method {name}")
    require(
        planner.max_views >= study.views,
        f"the method {name} makes a planner for {planner.max_views} views, but the study has {study.views}: give "
        f"Planner(max_views={study.views})",
    )
    return planner


def replay(study: Study, scene: Scene, run: Record) -> list[tuple[PointCloud, Observations]]:
    """Compute again the scan of each view and the observations after it, from a method's record `run`."""
    # Observations depend only on the capacity and the carving of a planner, which are the same for all methods.
    planner, sensor = study.planner(study.methods[0], scene), study.sensor(scene)
    keys = [view_keys(study.key(scene.index, "episode"), index)[2] for index in range(len(run["views"]))]
    views = [(pose, sensor(pose, key)) for pose, key in zip(poses_of(run), keys, strict=True)]
    scans = [scan for _, scan in views]
    return list(zip(scans, planner.replay(views, study.camera), strict=True))
