"""The study of the synthetic pyramid: which methods find the pattern on its base, and how soon is its class known?"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnbv.camera import Camera
from jaxnbv.cloud import PointCloud
from jaxnbv.datasets import Framing, Pyramid, Split, pyramid_scene
from jaxnbv.datasets.pyramid import choose_hidden, scan_pattern
from jaxnbv.episode import Sensor, Step
from jaxnbv.experiments.measures import Measure, Record
from jaxnbv.experiments.pyramid.choices import CLASSIFYING, Chooser, classify
from jaxnbv.experiments.pyramid.hits import (
    PATTERN_PIXELS,
    cumulative_share,
    first_hit,
    pattern_view,
    random_pattern_share,
    stable_hit,
)
from jaxnbv.experiments.study import Chart, Panel, Scene, Study
from jaxnbv.model_name import ModelName
from jaxnbv.networks import pyramid_classifier
from jaxnbv.planner import Planner
from jaxnbv.pose import Pose
from jaxnbv.presets import imagination
from jaxnbv.scanning import Grid, SDFSurface, SensorNoise
from jaxnbv.search import DiscreteSearch
from jaxnbv.tasks import Coverage
from jaxnbv.tasks.classification import Classifier

_RANDOM_RUNS = 8
_CHOSEN = "view being chosen"
# The last is held by older records alone: carved samples have nothing before the object.
_DIAGNOSTICS = {
    "rank_correlation": "Rank correlation",
    "roughness": "Roughness",
    "near_sensor": "Near-sensor share",
}
# Of the cameras from which the pattern cannot be seen two fifths lie in each of the first two, a fifth in the last.
_ANGLES = {"under 110": (0.0, 110.0), "110-140": (110.0, 140.0), "140-180": (140.0, 180.1)}


class Truth(eqx.Module):
    """What each candidate would truly show: scans with noise, and how many rays hit the pattern.

    - `angles`: of the candidates from the base's normal, in degrees; at 180 a camera looks from behind the apex.
    """

    pyramid: Pyramid
    scans: PointCloud
    pattern_pixels: Int[Array, " candidates"]
    angles: Float[Array, " candidates"]


def _hit(time_of: Callable) -> Callable[[Record, str], Float[np.ndarray, " views"]]:
    """The share of a method's runs that have hit, by view: for all but random search that of one run, 0 or 1."""

    def of(record: Record, method: str) -> Float[np.ndarray, " views"]:
        held = record["methods"][method]
        correct = [np.argmax(run["log_p"], axis=1) == record["label"] for run in held["runs"]]
        share = cumulative_share([time_of(run) for run in correct], len(correct[0]))
        if method == "random" and time_of is first_hit and len(share) >= 2:
            # Exact by view 2; all runs have the first view in common.
            share[1] = 1.0 if correct[0][0] else held.get("hit", record.get("random_hit"))
        return share

    return of


def _pattern(record: Record, method: str) -> Float[np.ndarray, " views"]:
    """Whether a view has shown the pattern, by view; of random search the exact share over all orders."""
    runs = record["methods"][method]["runs"]
    views = len(runs[0]["log_p"])
    if method == "random":
        return random_pattern_share(np.array(record["pattern_pixels"]), record["first"], views)
    return cumulative_share([pattern_view(np.array(run["pattern_pixels"])) for run in runs], views)


def _diagnostic(quantity: str) -> Callable[[Record, str], list[float | None]]:
    """By the view being chosen; of the posterior that the method's own views made."""

    def of(record: Record, method: str) -> list[float | None]:
        views = len(record["methods"][method]["runs"][0]["log_p"])
        return [_of_view(record, method, quantity, view) for view in range(2, views + 1)]

    return of


def _of_view(record: Record, method: str, quantity: str, view: int) -> float | None:
    # Older records hold them beside the methods.
    entries = record["methods"][method].get("diagnostics") or [
        entry | {"rank_correlation": entry["rank_correlation"].get(method)}
        for entry in record.get("diagnostics", ())
        if method in entry["methods"]
    ]
    found = [entry.get(quantity) for entry in entries if entry["view"] == view]
    return found[0] if found and found[0] is not None and np.isfinite(found[0]) else None


class PyramidStudy(Study):
    """The class of a pyramid whose pattern the first view does not show. Settings as of `Study`, and

    - `classifier`: of clouds in scene coordinates; it says what is known after each view.
    - `imagining`: the classifier of D u scan for imagined scans, by default the same; one that is fed fewer points
      saves time.
    - `framing`: how large the object stands before the sensor.
    - `split`: which scenes; tune on those of the validation split.
    - `num_points`: D is thinned to so many, once a step, before imagined scans are added to it.
    """

    title: ClassVar[str] = "The class of a pyramid"
    explanation: ClassVar[str] = (
        "First hit: a right prediction so far. Stable hit: right from then to the end. Pattern seen: one of the views\n"
        f"shows at least {PATTERN_PIXELS} pixels of it. Random search: exact expectation of pattern seen and of first\n"
        "hit by view 2, else a mean over runs. Diagnostics are by the view being chosen, in ( ) their scenes.\n"
        "Angles are of the first view from the base's normal."
    )
    methods: ClassVar[tuple[str, ...]] = (*CLASSIFYING, "coverage", "farthest", "uncertainty", "random", "oracle")
    reference: ClassVar[str] = "cross-entropy"
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("first", "First hit", _hit(first_hit), percent=True),
        Measure("stable", "Stable hit", _hit(stable_hit), percent=True),
        Measure("pattern", "Pattern seen", _pattern, percent=True),
        *(
            Measure(name, title, _diagnostic(name), first=2, digits=2, paired=False)
            for name, title in _DIAGNOSTICS.items()
        ),
    )
    charts: ClassVar[Mapping[str, Chart]] = {
        "hits": Chart((tuple(map(Panel, ("first", "stable", "pattern"))),)),
        "angles": Chart((tuple(map(Panel, ("first", "stable", "pattern"))),), by_group=True),
        "diagnostics": Chart(((Panel("rank_correlation", axis=_CHOSEN), Panel("roughness", axis=_CHOSEN)),)),
    }
    seed: ClassVar[int] = 2
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 40}
    quick_scenes: ClassVar[int] = 6

    classifier: Classifier = eqx.field(kw_only=True)
    imagining: Classifier | None = None
    framing: Framing = eqx.field(static=True, default=Framing.CLOSE_UP)
    split: Split = eqx.field(static=True, default=Split.TEST)
    num_points: int = eqx.field(static=True, default=512)

    @classmethod
    def configured(
        cls, model: ModelName, views: int, quick: bool, framing: Framing | None = None, **options: Any
    ) -> dict[str, Study]:
        """One for each framing, if none is given."""
        studies: dict[str, Study] = {}
        for one in Framing if framing is None else (framing,):
            classifier, imagining = (pyramid_classifier(one.longest_side, **s) for s in ({}, {"num_points": 512}))
            surfaces = imagination(model, one.longest_side, quick, solid=True)._asdict()
            settings = {"classifier": classifier, "imagining": imagining, "framing": one} | options
            studies[one.value] = cls(views=views, **surfaces | settings | (dict(cls.quick) if quick else {}))
        return studies

    @classmethod
    def groups(cls, records: Sequence[Record]) -> dict[str, list[Record]]:
        """All, and those in each bin of the first view's angle; no bin is empty."""
        bins = {name: [r for r in records if low <= r["angle"] < high] for name, (low, high) in _ANGLES.items()}
        return {"all": list(records)} | {f"first view at {name}°": of for name, of in bins.items() if of}

    def scene(self, index: int) -> Scene:
        """A pyramid; its task is the `Truth`."""
        truth = _truth(self.candidates.poses(), jnp.asarray(index), self.split, self.framing, self.camera)
        return Scene(index, f"pyramid {index}", SDFSurface(truth.pyramid), truth)

    def truth(self, scene: Scene) -> Truth:
        return scene.task

    def facts(self, scene: Scene, truth: Truth, first: int) -> Record:
        return {
            "name": scene.name,
            "framing": self.framing.value,
            "split": self.split.value,
            "label": int(truth.pyramid.label),
            "pattern_pixels": truth.pattern_pixels.tolist(),
            "angle": float(truth.angles[first]),
        }

    def first_view(self, scene: Scene) -> int:
        """A random one of the candidates that do not show the pattern, but something."""
        pixels = np.asarray(scene.task.pattern_pixels)
        return choose_hidden(pixels, scene.task.scans, self.key(scene.index, "first"))

    @property
    def grid(self) -> Grid:
        """In proportion to the object."""
        return Grid(self.grid_resolution, 0.7 * self.framing.longest_side)

    def planner(self, method: str, scene: Scene) -> Planner:
        """That of coverage, whose states and samples all methods share; a `Chooser` asks their scores."""
        return self.planner_of(Coverage(), DiscreteSearch(self.candidates))

    def sensor(self, scene: Scene) -> Sensor:
        """From a candidate the same scan for all methods and views."""
        anywhere, poses = super().sensor(scene), self.candidates.poses()

        def look(pose, key):
            index = _nearest(poses, pose)
            return anywhere(pose, key) if index is None else scene.task.scans[index]

        return look

    def run_methods(self, scene: Scene, truth: Truth, first: int, methods: Sequence[str]) -> dict[str, Record]:
        """All methods together: those that stand at the same place share its state and its samples."""
        chooser = self._chooser(scene)
        runs: dict[str, list[tuple[int, ...]]] = {method: [(first,)] for method in methods}
        if "random" in runs:
            runs["random"] = [self._random_run(scene.index, first, run) for run in range(_RANDOM_RUNS)]
        diagnostics: dict[str, list[Record]] = {method: [] for method in methods}
        for view in range(2, self.views + 1):
            together: dict[tuple[int, ...], list[str]] = {}
            for method in methods:
                if method != "random":
                    together.setdefault(runs[method][0], []).append(method)
            for visited, group in together.items():
                for method, choice in chooser.choose(visited, group, view).items():
                    runs[method] = [(*visited, choice.candidate)]
                    diagnostics[method].append({"view": view, **choice.diagnostics})
        found: dict[str, Record] = {
            method: {"runs": [self._run(chooser, truth, one) for one in of], "diagnostics": diagnostics[method]}
            for method, of in runs.items()
        }
        if "random" in found:
            correct = chooser.true_answers(first).argmax(axis=1) == int(truth.pyramid.label)
            found["random"]["hit"] = float(np.mean(np.delete(correct, first)))
        return found

    def _chooser(self, scene: Scene) -> Chooser:
        """For the choices of a scene."""
        planner, imagining = self.planner("coverage", scene), self.imagining or self.classifier
        truth, classifiers = scene.task, (self.classifier, imagining, self.num_points)
        return Chooser(planner, *classifiers, truth.scans, truth.pattern_pixels, self.key(scene.index, "scene"))

    def _run(self, chooser: Chooser, truth: Truth, visited: tuple[int, ...]) -> Record:
        log_p = [chooser.answer(visited[:count]).tolist() for count in range(1, len(visited) + 1)]
        pixels = np.asarray(truth.pattern_pixels)[list(visited)].tolist()
        return {"candidates": list(visited), "pattern_pixels": pixels, "log_p": log_p}

    def _random_run(self, index: int, first: int, run: int) -> tuple[int, ...]:
        others = np.delete(np.arange(self.num_candidates), first)
        key = jax.random.fold_in(self.key(index, "episode"), run)
        chosen = jax.random.choice(key, others, (self.views - 1,), replace=False)
        return (first, *(int(one) for one in chosen))

    def follow(
        self, scene: Scene, truth: Truth, method: str, methods: Sequence[str], episode: Iterator[Step]
    ) -> Record:
        """Of a method of one's own: what the classifier says after each view, and how much of the pattern it shows."""
        log_p, pixels = [], []
        for view, *_ in episode:
            log_p.append(np.asarray(classify(self.classifier, view.cloud)).tolist())
            pose = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], view.pose)
            pixels.append(int(scan_pattern(truth.pyramid, self.camera, pose)[0][0]))
        return {"runs": [{"pattern_pixels": pixels, "log_p": log_p}], "diagnostics": []}


def _nearest(poses: Pose, pose: Pose) -> int | None:
    """The candidate at a pose; None for a pose of another place or direction."""
    away = np.linalg.norm(np.asarray(poses.position) - np.asarray(pose.position), axis=1)
    turned = np.linalg.norm(np.asarray(poses.forward) - np.asarray(pose.forward), axis=1)
    index = int(np.argmin(away))
    return index if away[index] + turned[index] < 1e-3 else None


@eqx.filter_jit
def _truth(poses: Pose, index: Int[Array, ""], split: Split, framing: Framing, camera: Camera) -> Truth:
    pyramid = pyramid_scene(split, index, framing)
    pixels, scans = scan_pattern(pyramid, camera, poses)
    keys = jax.random.split(jax.random.fold_in(jax.random.key(3), index), len(pixels))
    direction = poses.position / jnp.linalg.norm(poses.position, axis=-1, keepdims=True)
    # The base looks along -z of the pyramid's own frame.
    angles = jnp.degrees(jnp.arccos(jnp.clip(-direction @ pyramid.rotation[:, 2], -1.0, 1.0)))
    return Truth(pyramid, jax.vmap(SensorNoise())(scans, keys), pixels, angles)
