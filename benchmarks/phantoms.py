"""Check expected new surface against truth: rank correlation, phantoms and their places, promised and found area.

    python benchmarks/phantoms.py --recorded FOLDER ... [--box ...] [--up ...] [--starts 6] [--views 6]
    python benchmarks/phantoms.py --mesh FILE ... [--above] [--bunny FILE] --work FOLDER

Meshes are first recorded into the --work folder by a noisy camera, whole in view, from all around, or with --above on a
table from the upper half. A *phantom* is sampled surface that counts as new and lies more than two voxels from
everything that the frames of the recording show. Its kind is the first of these that applies:

    cut     within a voxel of a face of the box, or beyond it
    empty   a ray of a previous view passed it by more than a voxel
    silent  on a ray of a previous view that had no return
    unseen  elsewhere

Rows are means over the starts, after each view. *rank*: correlation of expected and true gain over the remaining
frames. *chosen*: true gain of the frame with the largest expectation, as a share of the largest true gain. *phantom*:
share of the expected area, followed by the shares of the kinds in it. *covered*: share that `Covered` expects to be
seen. *promised* and *found*: area expected of the chosen frame, and added by its image, in squared scene units. *seen*
and *area*: share of the voxels, and of the area of a known mesh, that the views show, out of what all frames show. The
last line has these two at the view where `Covered(0.9)` would have stopped.
"""

import argparse
import itertools
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from recordings import Recorded, area_shown, of_bunny, of_mesh, study_of
from scipy.spatial import cKDTree
from scipy.stats import spearmanr

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import Pose
from jaxnbv.planning.loop import Loop
from jaxnbv.sampler import StepInputs
from jaxnbv.scanning import pixel_area, scan
from jaxnbv.scanning.looks import STEEP
from jaxnbv.studies.recorded import NEW_AREA, RecordedStudy
from jaxnbv.studies.shown_voxels import frame_of_box
from jaxnbv.tasks.coverage import Newness, seen_share

KINDS = ("cut", "empty", "silent", "unseen")
COLUMNS = ("rank", "chosen", "phantom", *KINDS, "covered", "promised", "found", "seen", "area")
_STOP_FRACTION = 0.9


class Case:
    """A recording as a study, with the surface that all of its frames show, in scene units."""

    def __init__(self, recorded: Recorded, views: int):
        self.study = study_of(recorded, views)
        self.recording = self.study.recording
        frame = frame_of_box(self.study.box)
        self.voxel = frame.scale * self.study.voxel
        area = None if recorded.mesh is None else area_shown(recorded)
        # Leave out points that no frame shows.
        self.area = None if area is None else area[:, area.any(axis=0)]
        self.shown_tree = cKDTree(np.asarray(frame.to_scene(jnp.asarray(self.recording.voxels))))

    def rows(self, start: int) -> Iterable[list[float]]:
        """The columns after each view of an episode by the study's own planner."""
        study, scene = self.study, self.study.scene(start)
        planner, recording = study.planner(NEW_AREA, scene), self.recording
        loop = Loop(planner, study.key(start, "episode"), camera=study.camera)
        visited: list[int] = []
        first = recording.poses[study.first_view(scene)]
        before: tuple[float, Newness] | None = None
        for step in itertools.islice(loop.steps(study.sensor(scene), first), study.views):
            visited.append(study.frame_of(step.view.pose))
            row = [np.nan] * len(COLUMNS)
            row[-2] = float(recording.is_shown[visited].any(axis=0).mean())
            if self.area is not None:
                row[-1] = float(self.area[visited].any(axis=0).mean())
            if before is not None:
                row[-4:-2] = before[0], float(_new_area(step.view.scan, step.view.pose, study, before[1]))
            inputs = loop.inputs()
            newness = planner.acquisition.context(inputs)
            if len(visited) < study.views:
                before = float(loop.propose().value), newness
            row[:-4] = self._judge(inputs, newness, visited)
            yield row

    def _judge(self, inputs: StepInputs, newness: Newness, visited: list[int]) -> list[float]:
        recording, camera, surfaces = self.recording, self.study.imagined_camera, inputs.surfaces
        areas, points = _expected(surfaces, newness, camera, recording.poses)
        expected = np.asarray(areas.sum(axis=-1).mean(axis=0))
        is_covered = recording.is_shown[visited].any(axis=0)
        gain = (recording.is_shown & ~is_covered).sum(axis=1)
        is_unvisited = ~np.isin(np.arange(len(gain)), visited)
        varies = np.ptp(expected[is_unvisited]) > 0 and np.ptp(gain[is_unvisited]) > 0
        rank = float(spearmanr(expected[is_unvisited], gain[is_unvisited])[0]) if varies else np.nan
        gain_ratio = gain[is_unvisited][expected[is_unvisited].argmax()] / max(1, gain[is_unvisited].max())
        weights, positions = np.asarray(areas).reshape(-1), np.asarray(points).reshape(-1, 3)
        weights, positions = weights[weights > 0], positions[weights > 0]
        is_phantom = self.shown_tree.query(positions)[0] > 2.0 * self.voxel
        kinds = self._kinds(positions[is_phantom], visited)
        phantom_fraction = weights[is_phantom].sum() / max(weights.sum(), 1e-9)
        of_kind = [weights[is_phantom][kinds == kind].sum() / max(weights[is_phantom].sum(), 1e-9) for kind in range(4)]
        covered = float(seen_share(newness, surfaces, camera, recording.poses, inputs.observations.poses))
        return [rank, gain_ratio, phantom_fraction, *of_kind, covered]

    def _kinds(self, positions: np.ndarray, visited: list[int]) -> np.ndarray:
        study, recording = self.study, self.recording
        volume = study.sampler.carving.volume
        is_cut = np.asarray(volume(jnp.asarray(positions))) > -self.voxel
        is_empty, is_silent = np.zeros(len(positions), bool), np.zeros(len(positions), bool)
        camera = study.camera
        for index in visited:
            pose, cloud = recording.poses[index], recording.scans[index]
            local = (positions - np.asarray(pose.position)) @ np.asarray(pose.rotation)
            is_ahead = local[:, 2] > 0
            pixel = np.asarray(
                camera.to_pixels(jnp.asarray(local[:, :2] / np.where(is_ahead, local[:, 2], 1.0)[:, None]))
            )
            column, row = np.floor(pixel).astype(int).T
            is_inside = is_ahead & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            ray = np.where(is_inside, row * camera.width + column, 0)
            sight = np.asarray(cloud.sight)[ray]
            has_return = np.isfinite(sight)
            is_empty |= is_inside & has_return & (sight > np.linalg.norm(local, axis=1) + self.voxel)
            is_silent |= is_inside & ~has_return
        return np.select([is_cut, is_empty, is_silent], [0, 1, 2], 3)


@jax.jit
def _expected(surfaces, newness: Newness, camera, poses: Pose):
    def of_sample(surface):
        def of_pose(pose):
            cloud = scan(surface, camera, pose)
            return pixel_area(cloud, camera, pose, STEEP) * newness(cloud.points), cloud.points

        return jax.lax.map(of_pose, poses, batch_size=32)

    return jax.lax.map(of_sample, surfaces)


def _new_area(cloud: PointCloud, pose: Pose, study: RecordedStudy, newness: Newness):
    return jnp.sum(pixel_area(cloud, study.camera, pose, STEEP) * newness(cloud.points))


def measure_rows(case: Case, starts: int) -> np.ndarray:
    """The numbers of the table before the mean: (starts, views, columns)."""
    return np.array([list(case.rows(start)) for start in range(starts)])


def shares_at_stop(rows: np.ndarray) -> np.ndarray:
    """Shares seen, by voxels and by area, when the expected share was first reached: (episodes that reached it, 2)."""
    is_enough = rows[..., COLUMNS.index("covered")] >= _STOP_FRACTION
    has_ended = is_enough.any(axis=1)
    return rows[has_ended, is_enough[has_ended].argmax(axis=1)][:, -2:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recorded", type=Path, nargs="*", default=[])
    parser.add_argument("--box", type=float, nargs=6)
    parser.add_argument("--up", type=float, nargs=3)
    parser.add_argument("--mesh", type=Path, nargs="*", default=[])
    parser.add_argument("--above", action="store_true")
    parser.add_argument("--bunny", type=Path)
    parser.add_argument("--work", type=Path, help="where recordings are made")
    parser.add_argument("--starts", type=int, default=6)
    parser.add_argument("--views", type=int, default=6)
    args = parser.parse_args()
    cases = [Recorded(folder.name, folder, args.box, args.up) for folder in args.recorded]
    for file in args.mesh:
        cases.append(of_mesh(file, args.work / f"{file.stem}-{'above' if args.above else 'around'}", args.above))
    if args.bunny is not None:
        cases.append(of_bunny(args.bunny, args.work / "bunny"))
    tables = []
    for recorded in cases:
        # Each object has its own box, and so its own programs. Those of twenty exceed the limit of memory maps.
        jax.clear_caches()
        tables.append(measure_rows(Case(recorded, args.views), args.starts))
        _show(recorded.name, np.mean(tables[-1], axis=0))
    episodes = np.concatenate(tables)
    if len(tables) > 1:
        _show(f"mean of {len(tables)}", np.mean(episodes, axis=0))
    shares = shares_at_stop(episodes)
    print(f"\nCovered({_STOP_FRACTION}) ends {len(shares)} of {len(episodes)} episodes; seen by then, in percent:")
    for name, column in zip(COLUMNS[-2:], 100 * shares.T, strict=True):
        # The area of a real recording is not known.
        if len(values := column[~np.isnan(column)]) == 0:
            continue
        print(f"{name:>6}: mean {values.mean():.1f}, least {values.min():.1f}, largest {values.max():.1f}")


def _show(name: str, table: np.ndarray) -> None:
    print(f"\n{name}\nview " + " ".join(f"{column:>8}" for column in COLUMNS))
    for view, row in enumerate(table, start=1):
        print(f"{view:4d} " + " ".join(f"{'':>8}" if np.isnan(value) else f"{value:8.2f}" for value in row), flush=True)


if __name__ == "__main__":
    main()
