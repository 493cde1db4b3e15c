"""What the studies of classification have in common: which methods' views tell the class, and how soon?"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int, Key

from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.networks import CloudClassifier, load_checkpoint, network_scale, pretrained_classifier
from jaxnbv.planning.episode import Sensor, Step, view_keys
from jaxnbv.planning.planner import Planner
from jaxnbv.scanning import Grid, SensorNoise
from jaxnbv.search import TieBreakSearch
from jaxnbv.studies.classification.measures import HITS_EXPLAINED, charts_of, hits_and_diagnostics
from jaxnbv.studies.classification.shared import OracleView, Shared, classify, propose_together
from jaxnbv.studies.engine.diagnostics import rank_correlation, roughness
from jaxnbv.studies.engine.measures import UNKNOWING, Claim, Measure, Record
from jaxnbv.studies.engine.meshes import numbered
from jaxnbv.studies.engine.study import RULES, Chart, Scene, Study, pose_record
from jaxnbv.studies.readers import MeshFile, class_meshes
from jaxnbv.studies.scenes import ClassObject, ClassSet, FirstView, Framing, Split
from jaxnbv.studies.scenes.class_object import ClassMesh, scan_cue, surface_of
from jaxnbv.tasks import Coverage, CrossEntropy, EntropyReduction, MixedEntropy
from jaxnbv.tasks.classification import ClassAcquisition, Classifier

# Of random search, in each scene.
_RUNS = 8
_BY_CLASS: dict[str, type[ClassAcquisition]] = {
    "cross-entropy": CrossEntropy,
    "entropy": EntropyReduction,
    "mixed": MixedEntropy,
    "tie-break": CrossEntropy,
    "oracle": CrossEntropy,
}
BASELINES = ("coverage", *RULES)


class Truth(eqx.Module):
    """The class, and what each candidate would truly show: scans with noise, and how many rays hit its cue."""

    label: int
    scans: PointCloud
    thing: ClassObject | ClassMesh
    pixels: Int[Array, " candidates"]


class ClassificationStudy(Study):
    """The class of an object. Settings as of `Study`, and

    - `classifier`: of clouds in scene coordinates; it says what is known after each view.
    - `imagining`: the classifier of D u scan for imagined scans, by default the same; one that is fed fewer points
      saves time.
    - `framing`: how large the object stands before the sensor.
    - `split`: which scenes; tune on those of the validation split.
    - `num_points`: D is thinned to so many, once a step, before imagined scans are added to it.
    - `meshes`: files in place of procedural objects, see `class_meshes`, where all of an object tells its class.
    - `first`: which views may be the first one.

    What it is:

    - `objects`: the scenes; `cue`: the part of them that differs by class, "" for all of the object.
    - `network`: the name of the shipped classifier; `fed`: the points that it is fed of what was seen, and of that and
      an imagined scan.
    - `framings`: each a study of its own; `solid`: whether the objects are nowhere thin, see `imagination`.
    """

    methods: ClassVar[tuple[str, ...]] = ("cross-entropy", "entropy", "mixed", "tie-break", *BASELINES, "oracle")
    reference: ClassVar[str] = "cross-entropy"
    explanation: ClassVar[str] = f"{HITS_EXPLAINED}Roughness is by the view being chosen, in ( ) its scenes."
    measures: ClassVar[tuple[Measure, ...]] = hits_and_diagnostics()
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Where local features tell the class, cross-entropy is right sooner than views that know nothing of the "
            "task, most of all at the second view.",
            "first",
            2,
            BASELINES,
        ),
    )
    charts: ClassVar[Mapping[str, Chart]] = charts_of()
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 40}
    quick_scenes: ClassVar[int] = 6

    objects: eqx.AbstractClassVar[ClassSet]
    cue: ClassVar[str] = ""
    network: eqx.AbstractClassVar[str]
    fed: ClassVar[tuple[int, int]] = (1024, 512)
    framings: ClassVar[tuple[Framing, ...]] = (Framing.CLOSE_UP,)
    solid: ClassVar[bool] = False
    unknowing: ClassVar[tuple[str, ...]] = ("coverage", "uncertainty")

    classifier: Classifier = eqx.field(kw_only=True)
    imagining: Classifier | None = None
    framing: Framing = eqx.field(static=True, default=Framing.CLOSE_UP)
    split: Split = eqx.field(static=True, default=Split.TEST)
    num_points: int = eqx.field(static=True, default=512)
    meshes: tuple[MeshFile, ...] = eqx.field(static=True, default=())
    first: FirstView = eqx.field(static=True, default=FirstView.ANY)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """One for each framing, if none is given.

        - `meshes`: a folder, see `class_meshes`.
        - `classifier`: the file of a network, see `load_checkpoint`, in place of the one that ships.

        **Raises:** `ValueError` as these do, or if the network does not tell as many classes.
        """
        if "meshes" in options:
            options["meshes"] = class_meshes(options["meshes"], cls.objects.classes)
        file = options.pop("classifier", None)
        studies: dict[str, Study] = {}
        for one in (options["framing"],) if "framing" in options else cls.framings:
            classifier, imagining = (cls._classifier(file, one.longest_side, fed) for fed in cls.fed)
            imagination = cls.imagined(model, one.longest_side, quick, cls.solid)
            settings: dict[str, Any] = {"classifier": classifier, "imagining": imagining, "framing": one} | options
            name = one.value if len(cls.framings) > 1 else ""
            studies[name] = cls(views=views, imagination=imagination, **settings | (dict(cls.quick) if quick else {}))
        return studies

    @classmethod
    def _classifier(cls, file: str | Path | None, longest_side: float, fed: int) -> CloudClassifier:
        if file is None:
            return pretrained_classifier(cls.network, longest_side, fed)
        network = load_checkpoint(file)
        classifier = CloudClassifier(network, fed, network_scale(network, longest_side))
        rows = jnp.zeros((fed, 3))
        (known,) = jax.eval_shape(classifier, PointCloud(rows, rows, jnp.ones(fed, bool))).shape
        names = cls.objects.classes
        require(
            known == len(names),
            f"the network in {file} knows {known} classes; the study has {len(names)}: {', '.join(names)}",
        )
        return classifier

    @classmethod
    def groups(cls, records: Sequence[Record]) -> dict[str, list[Record]]:
        """All, and those whose first view shows nothing of the cue of the class, and something; no group is empty."""
        parts: dict[str, list[Record]] = {"all": list(records)}
        if cls.cue:
            shown = [record[f"{cls.cue}_pixels"][record["first"]] > 0 for record in records]
            for word, wanted in (("without", False), ("with", True)):
                of = [record for record, shows in zip(records, shown, strict=True) if shows is wanted]
                parts |= {f"first view {word} {cls.cue}": of} if of else {}
        return parts

    @property
    def num_scenes(self) -> int | None:
        return len(self.meshes) or None

    def scene(self, index: int) -> Scene:
        """An object; its task is the `Truth`.

        **Raises:** `ValueError` if there is no mesh of this index, or it cannot be read.
        """
        poses = self.candidates.poses()
        keys = jax.random.split(jax.random.fold_in(jax.random.key(3), index), self.num_candidates)
        name, thing = self.thing(index)
        pixels, scans = scan_cue(thing, self.camera, poses)
        return Scene(index, name, surface_of(thing), Truth(int(thing.label), _noisy(scans, keys), thing, pixels))

    def thing(self, index: int) -> tuple[str, ClassObject | ClassMesh]:
        """The object of a scene and its name."""
        if self.objects.scene is not None and not self.meshes:
            return f"{self.network} {index}", self.objects.scene(self.split, index, self.framing)
        file = numbered(self.meshes, index)
        return f"{self.objects.classes[file.label]} {file.name}", self.of_mesh(file, index)

    def of_mesh(self, file: MeshFile, index: int) -> ClassMesh:
        """What a file of `meshes` gives."""
        return ClassMesh(file.read(), file.label)

    def truth(self, scene: Scene) -> Truth:
        return scene.task

    def facts(self, scene: Scene, truth: Truth, first: int) -> Record:
        known = {"name": scene.name, "framing": self.framing.value, "split": self.split.value}
        return known | {"label": truth.label} | self._shown(truth.pixels)

    @property
    def grid(self) -> Grid:
        """In proportion to the object."""
        return Grid(self.grid_resolution, 0.7 * self.framing.longest_side)

    def shows_enough(self, scene: Scene, seen: PointCloud) -> bool:
        """Something, of which the classifier may be wrong only, where `first` says so."""
        shows = super().shows_enough(scene, seen)
        if self.first is FirstView.ANY or not shows:
            return shows
        return int(classify(self.classifier, seen).argmax()) != scene.task.label

    @property
    def remedy(self) -> str:
        """Where `first` asks for more, to ask for less."""
        return super().remedy + ("" if self.first is FirstView.ANY else ", or ask for --first any")

    def planner(self, method: str, scene: Scene) -> Planner:
        classifier, candidates = self.imagining or self.classifier, self.candidates
        kind, coverage = _BY_CLASS.get(method), Coverage()
        acquisition = coverage if kind is None else kind(classifier, num_points=self.num_points)
        if method == "oracle":
            return self.planner_of(acquisition, OracleView(candidates, scans=scene.task.scans), scene)
        if method == "tie-break":
            return self.planner_of(acquisition, TieBreakSearch(candidates, second=coverage), scene)
        return self.planner_of(acquisition, self.search(method), scene)

    def sensor(self, scene: Scene) -> Sensor:
        """From a candidate the same scan for all methods and views."""
        anywhere, poses = super().sensor(scene), self.candidates.poses()

        def look(pose, key):
            index, is_there = _nearest(poses, pose)
            return scene.task.scans[index] if is_there else anywhere(pose, key)

        return look

    def run_methods(self, scene: Scene, truth: Truth, first: int, methods: Sequence[str]) -> dict[str, Record]:
        """All methods together: those that stand at the same place share its evidence, its samples and their scans."""
        planners = {method: self.planner_for(method, scene) for method in methods}
        shared = Shared(self.planner("coverage", scene), self.classifier, self.candidates.poses(), truth.scans)
        runs: dict[str, list[tuple[int, ...]]] = {method: [(first,)] for method in methods}
        if "random" in runs:
            runs["random"] = [self._random_run(scene, shared, planners["random"], first, run) for run in range(_RUNS)]
        diagnostics: dict[str, list[Record]] = {method: [] for method in methods}
        for view in range(1, self.views):
            together: dict[tuple[int, ...], dict[str, Planner]] = {}
            for method in (method for method in methods if method != "random"):
                together.setdefault(runs[method][0], {})[method] = planners[method]
            for visited, group in together.items():
                for method, (index, noted) in self._step(scene, shared, group, visited, view).items():
                    runs[method] = [(*visited, index)]
                    diagnostics[method].append({"view": view + 1, **noted})
        found: dict[str, Record] = {
            method: {
                "views": [pose_record(shared.poses[index]) for index in of[0]],
                "runs": [self._run(shared, truth, one) for one in of],
                "diagnostics": diagnostics[method],
            }
            for method, of in runs.items()
        }
        if "random" in found:
            correct = shared.second_answers(first).argmax(axis=1) == truth.label
            found["random"]["hit"] = float(np.mean(np.delete(correct, first)))
        return found

    def _step(
        self, scene: Scene, shared: Shared, planners: Mapping[str, Planner], visited: tuple[int, ...], view: int
    ) -> dict[str, tuple[int, Record]]:
        """The candidates that methods at one place choose as view `view` (from 0), with the keys of an episode; and how
        well their values agreed with what the candidates would truly show, and how rough the samples were."""
        evidence = shared.evidence(visited)
        sample_key, search_key, _ = view_keys(self.key(scene.index, "episode"), view)
        new = ~np.isin(np.arange(self.num_candidates), visited)
        found: dict[str, tuple[int, Record]] = {}
        # Those that imagine alike together: the study's own, and those that know no shapes.
        for unknowing in (False, True):
            group = {name: one for name, one in planners.items() if name.endswith(UNKNOWING) is unknowing}
            if not group:
                continue
            surfaces, rough = None, None
            if any(planner.search.uses_samples for planner in group.values()):
                imagination = next(iter(group.values())).imagination
                posterior = imagination.posterior(evidence)
                surfaces = imagination.sample(evidence, sample_key, posterior)
                rough = roughness(imagination, evidence, posterior, surfaces)
            for method, proposal in propose_together(group, evidence, surfaces, search_key).items():
                index, _ = _nearest(shared.poses, proposal.pose)
                shown = scene.task.pixels if self.cue else None
                rank = None if shown is None else rank_correlation(proposal.values, shown, new)
                own = rough if planners[method].search.uses_samples else None
                found[method] = index, {"rank_correlation": rank, "roughness": own}
        return found

    def _random_run(self, scene: Scene, shared: Shared, planner: Planner, first: int, run: int) -> tuple[int, ...]:
        """The candidates that a search at random chooses, in one of several runs."""
        key = jax.random.fold_in(self.key(scene.index, "episode"), run)
        visited: tuple[int, ...] = (first,)
        for view in range(1, self.views):
            _, search_key, _ = view_keys(key, view)
            index, _ = _nearest(shared.poses, planner.choose(shared.evidence(visited), None, search_key).pose)
            visited = (*visited, index)
        return visited

    def _run(self, shared: Shared, truth: Truth, visited: tuple[int, ...]) -> Record:
        log_p = [shared.answer(visited[:count]).tolist() for count in range(1, len(visited) + 1)]
        return {"candidates": list(visited), **self._shown(truth.pixels[np.array(visited)]), "log_p": log_p}

    def follow(
        self, scene: Scene, truth: Truth, method: str, methods: Sequence[str], episode: Iterator[Step]
    ) -> Record:
        """Of a method of one's own: what the classifier says after each view, and how much of it tells the class."""
        log_p, pixels = [], []
        for view, *_ in episode:
            log_p.append(np.asarray(classify(self.classifier, view.cloud)).tolist())
            pose = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], view.pose)
            pixels.append(int(scan_cue(truth.thing, self.camera, pose)[0][0]))
        return {"runs": [{**self._shown(pixels), "log_p": log_p}], "diagnostics": []}

    def _shown(self, pixels: Any) -> Record:
        """How many rays of each view hit the cue of the class, where that is a part of the object."""
        return {f"{self.cue}_pixels": np.asarray(pixels).tolist()} if self.cue else {}


@eqx.filter_jit
def _noisy(scans: PointCloud, keys: Key[Array, " candidates"]) -> PointCloud:
    return jax.vmap(SensorNoise())(scans, keys)


def _nearest(poses: Pose, pose: Pose) -> tuple[int, bool]:
    """The candidate nearest to a pose, and whether place and direction are the same."""
    away = np.linalg.norm(np.asarray(poses.position) - np.asarray(pose.position), axis=1)
    turned = np.linalg.norm(np.asarray(poses.forward) - np.asarray(pose.forward), axis=1)
    index = int(np.argmin(away))
    return index, bool(away[index] + turned[index] < 1e-3)
