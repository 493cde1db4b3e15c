"""A live view in the browser, by viser: what has been seen, what is imagined, and where to look next."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Float, UInt8
from matplotlib.colors import Colormap, to_rgb
from scipy.spatial.transform import Rotation

from jaxnbv.checks import checked
from jaxnbv.errors import optional
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.pose import Pose
from jaxnbv.imagination import Imagination
from jaxnbv.planning.episode import Episode, view_keys
from jaxnbv.planning.session import Session
from jaxnbv.scanning import Evidence
from jaxnbv.scanning.mesh import level_triangles
from jaxnbv.search import Proposal
from jaxnbv.storage.files import write_text
from jaxnbv.surfaces import KnownShapesPosterior, SurfacePosterior
from jaxnbv.viz.answers import may_be_words, shown_value, words_of
from jaxnbv.viz.mean_surface import as_shown, mean_surface
from jaxnbv.viz.render import depth_picture, depth_range
from jaxnbv.viz.style import BEFORE, DEVIATION, GREY, NEW, VALUE, round_range

_SAMPLES = 4
_EYE = (2.6, 1.7, 2.6)
_POINT, _CANDIDATE, _FRUSTUM = 0.012, 0.05, 0.22


class LiveView:
    """A page that shows an episode, or a session, and changes with it. All in scene coordinates, y up.

    Switched on in its scene tree: points, cameras, the surface of the posterior's mean coloured by how uncertain it is,
    candidates coloured by value, the next view with the depth that is expected of it; to be switched on: pieces of the
    mean that hold no points, and some imagined surfaces.

    - `port`, `host`: where the page is served, by default for this machine alone.

    **Raises:** `ValueError` if viser is not installed.
    """

    @checked
    def __init__(self, port: int = 8080, host: str = "127.0.0.1"):
        self._server: Any = optional("viser").ViserServer(host=host, port=port, verbose=False)
        self._server.scene.set_up_direction("+y")
        self._server.initial_camera.position, self._server.initial_camera.look_at = _EYE, (0.0, 0.0, 0.0)
        self._server.gui.configure_theme(control_width="medium")
        self._text = self._server.gui.add_markdown("nothing has been seen yet")
        self._image: Any = None
        self._drawn: list[Any] = []

    @property
    def address(self) -> str:
        """Of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def update(
        self,
        episode: Episode,
        proposal: Proposal | None = None,
        expected: Float[np.ndarray, "h w"] | None = None,
        evidence: Evidence | None = None,
    ) -> None:
        """Show an episode as it is now.

        - `proposal`: for the view after its last; `expected`: the depth image expected there.
        - `evidence`: after its last view, where that is at hand; made again from the scans otherwise.
        """
        evidence = episode.evidence_after(len(episode.views)) if evidence is None else evidence
        key, *_ = view_keys(episode.key, len(episode.views))
        posterior = episode.planner.imagination.posterior(evidence)
        picture = None if expected is None else depth_picture(expected, *depth_range([expected]))
        scene = self._server.scene
        with self._server.atomic():
            for handle in self._drawn:
                handle.remove()
            self._drawn = [
                *_points(scene, episode),
                *_cameras(scene, episode),
                *_mean(scene, episode.planner.imagination, evidence, posterior),
                *_imagined(scene, episode.planner.imagination, evidence, posterior, key),
                *([] if proposal is None else _choice(scene, episode.planner.camera, proposal, picture)),
            ]
        self._tell(episode, posterior, proposal, picture)

    def follow(self, session: Session) -> None:
        """Show a session from now on, with every image and proposal."""

        def show(session: Session) -> None:
            asked = session.next_view
            proposal, expected = (None, None) if asked is None else (asked.proposal, asked.expected_depth)
            self.update(session.episode, proposal, expected, session.evidence)

        session.follow(show)

    def save(self, path: str | Path) -> Path:
        """Write the scene as it is now as one HTML file, which opens offline."""
        write_text(Path(path), self._server.get_scene_serializer().as_html())
        return Path(path)

    def stop(self) -> None:
        """Serve it no more."""
        self._server.stop()

    def _tell(
        self, episode: Episode, posterior: SurfacePosterior, proposal: Proposal | None, picture: np.ndarray | None
    ) -> None:
        views, sought = len(episode.views), episode.planner.quantity
        lines = [f"**{views} view{'s' if views > 1 else ''}**, {int(episode.cloud.count):,} points kept"]
        answer = episode.planner.acquisition.answer(episode.cloud)
        lines += [] if answer is None else [words_of(answer).sentence()]
        if isinstance(posterior, KnownShapesPosterior):
            lines.append(may_be_words(tuple(posterior.kinds().items())))
        if proposal is not None:
            error = proposal.standard_error
            about = "" if error is None else f" ± {error:.2g}"
            lines.append(f"The next view has a {sought.name} of {shown_value(sought, float(proposal.value))}{about}.")
        self._text.content = "\n\n".join(lines)
        if self._image is not None:
            self._image.remove()
        self._image = None if picture is None else self._server.gui.add_image(picture, label="depth expected there")


def _points(scene: Any, episode: Episode) -> list[Any]:
    new, _ = episode.views[-1].scan.to_numpy()
    before = episode.views[-2].cloud.to_numpy()[0] if len(episode.views) > 1 else new[:0]
    return [
        scene.add_point_cloud(f"/points/{name}", points, _rgb(colour), point_size=_POINT, point_shape="circle")
        for name, points, colour in (("before", before, BEFORE), ("new", new, NEW))
        if len(points)
    ]


def _cameras(scene: Any, episode: Episode) -> list[Any]:
    found = []
    for number, view in enumerate(episode.views, start=1):
        colour = NEW if number == len(episode.views) else GREY
        found.append(_frustum(scene, f"/cameras/view {number}", view.camera, view.pose, colour))
        # It goes with its camera.
        scene.add_label(f"/cameras/view {number}/number", str(number))
    return found


def _mean(scene: Any, imagination: Imagination, evidence: Evidence, posterior: SurfacePosterior) -> list[Any]:
    surface, guesses = as_shown(mean_surface(imagination, evidence, posterior), evidence.cloud)
    found = []
    if surface is not None:
        low, high = round_range(*np.percentile(surface.deviation, [2.0, 98.0]).tolist())
        share = mpl.colors.LogNorm(low, high, clip=True)(surface.deviation)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=_colours(DEVIATION, share), process=False)
        found.append(scene.add_mesh_trimesh("/surface of the mean", mesh))
    if guesses is not None:
        settings: dict[str, Any] = {"color": _rgb(GREY), "opacity": 0.35, "visible": False}
        found.append(scene.add_mesh_simple("/guesses apart from it", guesses.vertices, guesses.faces, **settings))
    return found


def _imagined(
    scene: Any, imagination: Imagination, evidence: Evidence, posterior: SurfacePosterior, key: Any
) -> list[Any]:
    shapes = [""] * _SAMPLES
    if isinstance(posterior, KnownShapesPosterior):
        shapes = [f" {name}" for name in posterior.names_of_samples(key, imagination.num_samples)]
    # Marching cubes asks for an array that it could write to.
    values = np.array(imagination.sample(evidence, key, posterior).values[:_SAMPLES])
    found = []
    for number, (one, shape) in enumerate(zip(values, shapes, strict=False), start=1):
        if (triangles := level_triangles(one, imagination.grid)) is not None:
            settings: dict[str, Any] = {"color": _rgb("#8fb8d8"), "opacity": 0.9, "visible": False}
            found.append(scene.add_mesh_simple(f"/imagined/{number}{shape}", *triangles[:2], **settings))
    return found


def _choice(scene: Any, camera: Camera, proposal: Proposal, picture: np.ndarray | None) -> list[Any]:
    values = np.asarray(proposal.values, np.float64)
    open_ = np.isfinite(values)
    places = np.asarray(proposal.candidates.position)[open_]
    found = []
    if open_.any():
        low, high = float(values[open_].min()), float(values[open_].max())
        colours = _colours(VALUE, (values[open_] - low) / max(high - low, 1e-12))[:, :3]
        found.append(scene.add_point_cloud("/candidates", places, colours, point_size=_CANDIDATE, point_shape="circle"))
    return [*found, _frustum(scene, "/next view", camera, proposal.pose, "#009e73", picture)]


def _frustum(
    scene: Any, name: str, camera: Camera, pose: Pose, colour: str, picture: UInt8[np.ndarray, "h w 3"] | None = None
) -> Any:
    left, above, right, below = camera.edges
    return scene.add_camera_frustum(
        name,
        fov=camera.fov,
        aspect=(right - left) / (below - above),
        scale=_FRUSTUM,
        color=_rgb(colour),
        image=picture,
        wxyz=Rotation.from_matrix(np.asarray(pose.rotation, np.float64)).as_quat(scalar_first=True),
        position=np.asarray(pose.position, np.float64),
    )


def _colours(scale: Colormap, share: np.ndarray) -> UInt8[np.ndarray, "*n 4"]:
    return np.round(255.0 * np.asarray(scale(np.asarray(share)))).astype(np.uint8)


def _rgb(colour: str) -> tuple[int, int, int]:
    red, green, blue = (round(255 * share) for share in to_rgb(colour))
    return red, green, blue
