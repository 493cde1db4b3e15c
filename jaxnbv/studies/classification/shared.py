"""What the methods of one scene have in common, computed once: evidence, answers, and scores of the same scans."""

import functools
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from jaxnbv.acquisition import Acquisition, Several, scores
from jaxnbv.geometry.cloud import PointCloud, concatenate
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.planner import Planner, checked_proposal
from jaxnbv.scanning import Evidence, GridSurface
from jaxnbv.search import CandidateSearch, Problem, Proposal
from jaxnbv.search.base import Scores, best_unvisited
from jaxnbv.tasks.classification import ClassAcquisition, ClassComparisons, Classifier


class Shared:
    """What is known after the views of some candidates, and what the classifier says then.

    - `planner`: whose evidence all methods share.
    - `classifier`: of all that was seen.
    - `poses`, `scans`: the candidates, and what each would truly show.
    """

    def __init__(self, planner: Planner, classifier: Classifier, poses: Pose, scans: PointCloud):
        self.planner, self.classifier, self.poses, self.scans = planner, classifier, poses, scans
        self.evidence, self.answer = functools.cache(self._evidence), functools.cache(self._answer)

    def _evidence(self, visited: tuple[int, ...]) -> Evidence:
        """After the views of these candidates."""
        *before, last = visited
        pose, seen = self.poses[last], self.scans[last]
        return self.planner.observe(self.evidence((*before,)), pose, seen) if before else self.planner.init(pose, seen)

    def _answer(self, visited: tuple[int, ...]) -> Float[np.ndarray, " classes"]:
        """log p after the views of these candidates."""
        return np.asarray(classify(self.classifier, self.evidence(visited).cloud))

    def second_answers(self, first: int) -> Float[np.ndarray, "candidates classes"]:
        """log p after the first view and each of the candidates."""
        return np.asarray(_answers(self.classifier, self.evidence((first,)).cloud, self.scans))


class OracleView(CandidateSearch):
    """The candidate whose true scan has the highest value: what the acquisition would choose that knows the surface.

    - `scans`: what each candidate would truly show.
    """

    scans: PointCloud = eqx.field(kw_only=True)
    uses_samples: ClassVar[bool] = False

    def score(self, problem: Problem, candidates: Pose) -> Float[Array, "1 1 candidates"]:
        """The values of the true scans."""
        context = problem.acquisition.context(problem.evidence.cloud)
        return scores(problem.acquisition, context, self.scans, problem.camera, candidates)[None, None]

    def pick(self, problem: Problem, candidates: Pose, scores: Scores, key: PRNGKeyArray) -> Proposal:
        """The argmax over the candidates not visited yet; the key is not used."""
        return best_unvisited(problem, candidates, scores[0, 0])


def propose_together(
    planners: Mapping[str, Planner], evidence: Evidence, surfaces: GridSurface | None, key: PRNGKeyArray
) -> dict[str, Proposal]:
    """What each planner proposes given the same evidence and samples: all are asked about the same scans, which are
    made once. The planners differ in acquisition and search alone, and their searches have the same candidates.

    **Raises:** `ValueError` as `Planner.choose` does.
    """
    asked: list[Acquisition] = []
    rows: dict[str, list[int]] = {}
    searches: dict[str, CandidateSearch] = {}
    for name, planner in planners.items():
        assert isinstance(planner.search, CandidateSearch)
        searches[name] = planner.search
        rows[name] = [_place(asked, acquisition) for acquisition in planner.search.asks(planner.acquisition)]
    problems = {name: planner.problem(evidence, surfaces) for name, planner in planners.items()}
    candidates = next(iter(searches.values())).candidates.poses()
    scores = _scores(asked, next(iter(problems.values())), candidates) if asked else None
    found = {}
    for name, search in searches.items():
        own = None if scores is None or not rows[name] else scores[jnp.asarray(rows[name])]
        found[name] = checked_proposal(_pick(search, problems[name], candidates, own, key), surfaces)
    return found


def _place(asked: list[Acquisition], acquisition: Acquisition) -> int:
    """Where an acquisition stands among those that are asked, put there if it is new."""
    for place, other in enumerate(asked):
        if bool(eqx.tree_equal(acquisition, other)):
            return place
    asked.append(acquisition)
    return len(asked) - 1


def _scores(asked: list[Acquisition], problem: Problem, candidates: Pose) -> Scores:
    """The scores of all; those of a classifier from one answer of it a scan."""
    by_class = {place: one for place, one in enumerate(asked) if isinstance(one, ClassAcquisition)}
    others = [place for place in range(len(asked)) if place not in by_class]
    members: list[Acquisition] = [asked[place] for place in others]
    if by_class:
        members.append(ClassComparisons.of(list(by_class.values())))
    scores = _scored(problem, Several(tuple(members)), candidates)
    return scores[jnp.argsort(jnp.asarray([*others, *by_class]))]


@eqx.filter_jit
def _scored(problem: Problem, several: Several, candidates: Pose) -> Scores:
    return problem.about(several).scores(candidates)


@eqx.filter_jit
def _pick(
    search: CandidateSearch,
    problem: Problem,
    candidates: Pose,
    scores: Scores | None,
    key: PRNGKeyArray,
) -> Proposal:
    scores = search.score(problem, candidates) if scores is None else scores
    return search.pick(problem, candidates, scores, key)


@eqx.filter_jit
def classify(classifier: Classifier, cloud: PointCloud) -> Float[Array, " classes"]:
    """log p, compiled."""
    return classifier(cloud)


@eqx.filter_jit
def _answers(classifier: Classifier, cloud: PointCloud, scans: PointCloud) -> Float[Array, "scans classes"]:
    return jax.lax.map(lambda one: classifier(concatenate(cloud, one)), scans)
