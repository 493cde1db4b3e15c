"""Base class of studies that count the views that a method needs to tell the class of an object."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, inputs_of, scores
from jaxnbv.checks import require
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.networks import CloudClassifier, load_checkpoint, network_scale, pretrained_classifier
from jaxnbv.planning.loop import Sensor, Step
from jaxnbv.planning.planner import Planner
from jaxnbv.programs import program
from jaxnbv.readers import MeshFile, class_meshes
from jaxnbv.sampler import SurfaceSampler
from jaxnbv.scanning import Grid, SensorNoise
from jaxnbv.search import CandidateSearch, Problem, Proposal, Search, TieBreakSearch
from jaxnbv.search.base import Scores, best_unvisited
from jaxnbv.studies.classification.measures import CUE_PIXELS, MEASURES, rank_correlation, roughness
from jaxnbv.studies.classification.pictures import prediction_picture
from jaxnbv.studies.engine.known import study_sampler
from jaxnbv.studies.engine.measures import Claim, Measure, Record
from jaxnbv.studies.engine.searches import BASELINES
from jaxnbv.studies.engine.study import Scene, Study
from jaxnbv.studies.engine.tiles import ScenePicture
from jaxnbv.studies.scenes import ClassObject, ClassSet, FirstView, Framing, Split
from jaxnbv.studies.scenes.class_object import ClassMesh, scan_cue, surface_of
from jaxnbv.tasks import Coverage, CrossEntropy, EntropyReduction, MixedEntropy
from jaxnbv.tasks.classification import AnyClassifier, ClassAcquisition, Classifier, as_classifier

# Seed of the noise in the candidates' scans. It is not `Study.seed`, because published records were made with this one.
_NOISE_SEED = 3
# Number of runs of random search in each scene.
_NUM_RANDOM_RUNS = 8
OTHERS = ("coverage", *BASELINES)
_GRADIENT = ("gradient-2dof", "gradient-constrained")
# Acquisitions of methods; None stands for `Coverage`. All other methods use cross-entropy, each with its own search.
_ACQUISITIONS: dict[str, type[ClassAcquisition] | None] = {
    **dict.fromkeys(OTHERS),
    "entropy": EntropyReduction,
    "mixed": MixedEntropy,
}


class Truth(eqx.Module):
    """The class of a scene's object, and what the candidates show of the object.

    - `scans`: noisy scan of the true object from each candidate.
    - `cue_pixels`: number of each candidate's rays that hit the cue, the part of the object that tells its class.
    """

    label: int
    scans: PointCloud
    class_object: ClassObject | ClassMesh
    cue_pixels: Int[Array, " candidates"]


class OracleView(CandidateSearch):
    """Oracle that chooses the candidate whose true scan (in `scans`) has the highest acquisition score."""

    scans: PointCloud = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = False

    def score(self, problem: Problem, candidates: Pose) -> Float[Array, "1 1 candidates"]:
        context = problem.acquisition.context(inputs_of(problem.observations))
        return scores(problem.acquisition, context, self.scans, problem.camera, candidates)[None, None]

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        return best_unvisited(problem, candidates, scores[0, 0])


class ClassificationStudy(Study):
    """Base class of studies that measure how many views a method needs to tell the class of an object.

    The noise in scans from the candidates does not depend on `seed`. With the model `known`, the known shapes are those
    of the shipped `bank`, also for scenes of `meshes`. The study has the settings of `Study`, and:

    - `classifier`: classifier of the cloud after each view, in scene coordinates.
    - `imagined_classifier`: classifier of the cloud joined with an imagined scan; default: `classifier`. A classifier
      that gets fewer points saves time.
    - `framing`: size of the object in the image, and so how much of the object a view shows.
    - `split`: split from which the scenes come. Tune settings on the validation split.
    - `num_points`: number of points to which the cloud is thinned, once per step, before imagined scans are added.
    - `first`: which first views are allowed.

    Class attributes:

    - `objects`: the scenes and their classes.
    - `cue`: name of the part of the object that differs by class, such as "cargo"; "" for the whole object.
    - `network`: name of the shipped classifier.
    - `network_points`: numbers of points that `classifier` and `imagined_classifier` get.
    - `framings`: framings for which a command makes one study each.
    - `solid`: whether the objects have no thin parts, see `SurfaceSampler.preset`.
    """

    methods: ClassVar[tuple[str, ...]] = ("cross-entropy", "entropy", "mixed", "tie-break", *OTHERS, "oracle")
    extra_methods: ClassVar[tuple[str, ...]] = ("halving", *_GRADIENT, "hybrid")
    pictured: ClassVar[tuple[str, ...]] = ("cross-entropy", "farthest", "uncertainty")
    reference: ClassVar[str] = "cross-entropy"
    explanation: ClassVar[str] = (
        "First hit: at least one prediction up to this view is right. Stable hit: all predictions from this view on\n"
        f"are right. For random search, both are means over {_NUM_RANDOM_RUNS} runs. Cue seen: this view or an earlier "
        "one shows\n"
        f"at least {CUE_PIXELS} pixels of the part that differs by class. Rank correlation and roughness at a view\n"
        "belong to the search that proposed this view."
    )
    measures: ClassVar[tuple[Measure, ...]] = MEASURES
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim(
            "Where local features tell the class, cross-entropy is right sooner than methods that ignore the task, "
            "most of all at the second view.",
            "first",
            2,
            OTHERS,
        ),
        Claim(
            "Search over candidates tells the class as soon as search by gradient, or nearly so.",
            "stable",
            2,
            _GRADIENT,
            must_be_better=False,
        ),
    )
    quick: ClassVar[Mapping[str, Any]] = {**Study.quick, "num_candidates": 40}
    quick_scenes: ClassVar[int] = 6
    paper: ClassVar[Mapping[str, Any]] = {**Study.paper, "num_points": 1024, "imagined_classifier": None}

    objects: eqx.AbstractClassVar[ClassSet]
    cue: ClassVar[str] = ""
    network: eqx.AbstractClassVar[str]
    network_points: ClassVar[tuple[int, int]] = (1024, 512)
    framings: ClassVar[tuple[Framing, ...]] = (Framing.CLOSE_UP,)
    solid: ClassVar[bool] = False

    classifier: AnyClassifier = eqx.field(kw_only=True, converter=as_classifier)
    imagined_classifier: Classifier | None = None
    framing: Framing = eqx.field(static=True, default=Framing.CLOSE_UP)
    split: Split = eqx.field(static=True, default=Split.TEST)
    num_points: int = eqx.field(static=True, default=512)
    first: FirstView = eqx.field(static=True, default=FirstView.ANY)

    @classmethod
    def configured(cls, model: str, views: int, quick: bool, **options: Any) -> dict[str, Study]:
        """Return one study for each of `framings`, or only for the option `framing` if it is given.

        The keys are the values of the framings, or "" if `framings` has only one. The option `classifier` is the file
        of a network, see `load_checkpoint`; default: the shipped network.

        **Raises:** `ValueError` if the network has a different number of classes than the study, and whenever
        `load_checkpoint` raises it.
        """
        if "meshes" in options:
            options["meshes"] = cls.files_in(options["meshes"])
        file = options.pop("classifier", None)
        studies: dict[str, Study] = {}
        for framing in (options["framing"],) if "framing" in options else cls.framings:
            classifier, imagined = (cls._classifier(file, framing.longest_side, count) for count in cls.network_points)
            sampler = study_sampler(model, cls.bank, (), framing.longest_side, quick, cls.solid)
            settings: dict[str, Any] = {"classifier": classifier, "imagined_classifier": imagined, "framing": framing}
            settings |= (dict(cls.quick) if quick else {}) | options
            name = framing.value if len(cls.framings) > 1 else ""
            studies[name] = cls(views=views, sampler=sampler, **settings)
        return studies

    @classmethod
    def files_in(cls, folder: str | Path) -> tuple[MeshFile, ...]:
        return class_meshes(folder, cls.objects.classes)

    @classmethod
    def _classifier(cls, file: str | Path | None, longest_side: float, num_points: int) -> CloudClassifier:
        if file is None:
            return pretrained_classifier(cls.network, longest_side, num_points)
        network = load_checkpoint(file)
        classifier = CloudClassifier(network, num_points, network_scale(network, longest_side))
        rows = jnp.zeros((num_points, 3))
        (num_classes,) = jax.eval_shape(classifier, PointCloud(rows, rows, jnp.ones(num_points, bool))).shape
        names = cls.objects.classes
        require(
            num_classes == len(names),
            f"the network in {file} knows {num_classes} classes; the study has {len(names)}: {', '.join(names)}",
        )
        return classifier

    @classmethod
    def group(cls, record: Record) -> str:
        """Return the name of the scene's group, by whether the first view shows the cue; "" without a cue."""
        if not cls.cue:
            return ""
        # All methods share the first view.
        pixels = next(iter(record["methods"].values()))["pixels"]
        return f"first view {'with' if pixels[0][0] else 'without'} {cls.cue}"

    def scene(self, index: int) -> Scene:
        """Return the scene with this index. Its `task` is a `Truth`.

        **Raises:** `ValueError` if there is no mesh with this index, or if the mesh cannot be read.
        """
        keys = jax.random.split(jax.random.fold_in(jax.random.key(_NOISE_SEED), index), self.num_candidates)
        file = self.mesh_file(index)
        class_object: ClassObject | ClassMesh
        if file is None:
            assert self.objects.scene is not None
            name, class_object = f"{self.network} {index}", self.objects.scene(self.split, index, self.framing)
        else:
            name, class_object = f"{self.objects.classes[file.label]} {file.name}", self.of_mesh(file, index)
        cue_pixels, scans = scan_cue(class_object, self.camera, self.candidates.poses())
        truth = Truth(int(class_object.label), _noisy(scans, keys), class_object, cue_pixels)
        return Scene(index, name, surface_of(class_object), truth)

    def of_mesh(self, file: MeshFile, index: int) -> ClassMesh:
        """Return the object of a mesh file for the scene with this index."""
        return ClassMesh(file.read(), file.label)

    def scene_record(self, scene: Scene, truth: Truth, first: int) -> Record:
        return {"name": scene.name, "framing": self.framing.value, "split": self.split.value, "label": truth.label}

    @property
    def grid(self) -> Grid:
        """The grid on which samples are evaluated. Its extent is proportional to the object's size."""
        return Grid(self.grid_resolution, 0.7 * self.framing.longest_side)

    def shows_enough(self, scene: Scene, scan: PointCloud) -> bool:
        """Return whether a scan shows the object and meets the condition `first`."""
        is_enough = super().shows_enough(scene, scan)
        if self.first is FirstView.ANY or not is_enough:
            return is_enough
        return int(_classify(self.classifier, scan).argmax()) != scene.task.label

    def sampler_of(self, scene: Scene) -> SurfaceSampler:
        """Return the study's sampler. Its known shapes, if any, are not the study's meshes."""
        return self.sampler

    def acquisition(self, method: str, scene: Scene) -> Acquisition:
        kind = _ACQUISITIONS.get(method, CrossEntropy)
        return kind(self.imagined_classifier or self.classifier, num_points=self.num_points) if kind else Coverage()

    def search(self, method: str, scene: Scene) -> Search:
        if method == "oracle":
            return OracleView(self.candidates, scans=scene.task.scans)
        if method == "tie-break":
            return TieBreakSearch(self.candidates, second=Coverage())
        return super().search(method, scene)

    def sensor(self, scene: Scene) -> Sensor:
        """Return a sensor whose scan from a candidate is the same for all methods and at all views."""
        base_sensor, poses = super().sensor(scene), self.candidates.poses()

        def look(pose, key):
            differences = [np.asarray(poses.position) - pose.position, np.asarray(poses.forward) - pose.forward]
            distances = np.linalg.norm(np.concatenate(differences, axis=1), axis=1)
            return scene.task.scans[int(distances.argmin())] if distances.min() < 1e-3 else base_sensor(pose, key)

        return look

    def episode_keys(self, method: str, scene: Scene) -> list[PRNGKeyArray]:
        """Return eight random keys for random search, and one for other methods."""
        keys = super().episode_keys(method, scene)
        return [jax.random.fold_in(keys[0], run) for run in range(_NUM_RANDOM_RUNS)] if method == "random" else keys

    def merge_runs(self, runs: Sequence[Record]) -> Record:
        """Return the record of the first run, with the predictions and cue pixels of all runs."""
        return runs[0] | {name: [row for run in runs for row in run[name]] for name in ("log_p", "pixels")}

    def follow(self, scene: Scene, truth: Truth, planner: Planner, episode: Iterator[Step]) -> Record:
        """Record the classifier's predictions after each view, and measures of each view.

        - Each view: the log probabilities of the classes, and the number of the view's rays that hit the cue.
        - Each proposed view: the `roughness` of the samples by which it was chosen, and the rank correlation, over the
          candidates, between the values and the numbers of rays that hit the cue.
        """
        lists: dict[str, list] = {name: [] for name in ("log_p", "pixels", "rank_correlation", "roughness")}
        for view, _, inputs, _ in episode:
            lists["log_p"].append(np.asarray(_classify(self.classifier, view.cloud)).tolist())
            pose = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], view.pose)
            lists["pixels"].append(int(scan_cue(truth.class_object, self.camera, pose)[0][0]))
            rank = None
            if self.cue and view.proposal is not None and len(view.proposal.values) == self.num_candidates:
                values = np.asarray(view.proposal.values)
                rank = rank_correlation(values, truth.cue_pixels, np.isfinite(values))
            lists["rank_correlation"].append(rank)
            lists["roughness"].append(None if inputs is None else roughness(planner.sampler, inputs))
        return lists | {"log_p": [lists["log_p"]], "pixels": [lists["pixels"]] if self.cue else []}

    def scene_picture(self, record: Record, methods: Sequence[str], pixels: int) -> ScenePicture:
        scene = self.scene(record["scene"])
        return prediction_picture(scene, record, methods, pixels, self.objects.classes, self.cue)


@program
def _noisy(scans: PointCloud, keys: Key[Array, " candidates"]) -> PointCloud:
    return jax.vmap(SensorNoise())(scans, keys)


@program
def _classify(classifier: Classifier, cloud: PointCloud) -> Float[Array, " classes"]:
    return classifier(cloud)
