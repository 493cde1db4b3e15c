"""A live view in the browser, made with viser: scanned points, imagined surfaces, and the next view."""

import dataclasses
import html
import threading
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import trimesh
from jaxtyping import Float, PRNGKeyArray, UInt8
from matplotlib.colors import Colormap, LogNorm, Normalize, to_rgb
from scipy.spatial.transform import Rotation

from jaxnbv.checks import checked
from jaxnbv.errors import optional
from jaxnbv.geometry.camera import Camera
from jaxnbv.geometry.frame import Frame
from jaxnbv.geometry.pose import Pose
from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.loop import view_keys
from jaxnbv.planning.session import Session
from jaxnbv.sampler import StepInputs, SurfaceSampler
from jaxnbv.search import Proposal
from jaxnbv.storage.files import write_text
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.utility import Answer, Quantity
from jaxnbv.viz import style
from jaxnbv.viz.answers import capital, kinds_text, value_text, words_of
from jaxnbv.viz.choice import candidate_values, colour_range
from jaxnbv.viz.imagined import NUM_SHOWN, Triangles, sampled_surfaces
from jaxnbv.viz.mean_surface import MeanSurface
from jaxnbv.viz.placed_shape import PlacedShape, placed_parts
from jaxnbv.viz.scene import Cameras, Points, scene_items
from jaxnbv.viz.shown_surface import shown_surface
from jaxnbv.viz.task import coverage_answers
from jaxnbv.viz.words import pose_text

_NEXT_COLOUR = "#009e73"
_EYE = (2.6, 1.7, 2.6)
_POINT_SIZE, _CANDIDATE_SIZE, _FRUSTUM_SIZE = 0.012, 0.05, 0.22
_PANEL_STYLE = (
    "position:fixed;left:0;top:0;max-height:100vh;overflow:auto;max-width:22em;padding:0 1em;background:#fffd;"
    "color:#222;font:15px sans-serif"
)


class LiveView:
    """A web page that shows an episode or a session.

    The page shows points, cameras, candidates coloured by value, and the next view with its expected depth, in scene
    coordinates. The surface is the likeliest known shape, or else the posterior mean coloured by its uncertainty.
    Imagined surfaces can be switched on in the scene tree. A slider goes back to earlier views. `stop` stops the server
    at `address`.

    - `port`, `host`: address of the page. By default only this machine can open it.

    **Raises:** `ValueError` if viser is not installed.
    """

    @checked
    def __init__(self, port: int = 8080, host: str = "127.0.0.1"):
        self._server: Any = optional("viser").ViserServer(host=host, port=port, verbose=False)
        self._server.scene.set_up_direction("+y")
        self._server.initial_camera.position, self._server.initial_camera.look_at = _EYE, (0.0, 0.0, 0.0)
        self._server.gui.configure_theme(control_width="medium")
        self._text = self._server.gui.add_markdown("nothing has been seen yet")
        self._legend = self._server.gui.add_html("")
        self._image: Any = None
        self._slider: Any = None
        self._handles: list[Any] = []
        # The user may move the slider while the next view is drawn.
        self._drawing = threading.RLock()

    @property
    def address(self) -> str:
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def update(self, shown: Episode | Session) -> None:
        """Show an episode, or a session with the pose of its next image."""
        episode = shown.episode if isinstance(shown, Session) else shown
        proposal, expected, observations = None, None, None
        if isinstance(shown, Session):
            observations = shown.observations
            if shown.next_view is not None:
                proposal, expected = shown.next_view.proposal, shown.expected_depth()
        views = episode.views

        def show(count: int) -> None:
            if count == len(views):
                self._show(episode, proposal, expected, observations)
            else:
                self._show(dataclasses.replace(episode, views=views[:count]), views[count].proposal)

        with self._drawing:
            if self._slider is not None:
                self._slider.remove()
            self._slider = None
            if len(views) > 1:
                self._slider = self._server.gui.add_slider("after view", 1, len(views), 1, len(views))
                self._slider.on_update(lambda event: show(event.target.value))
            show(len(views))

    def _show(
        self,
        episode: Episode,
        proposal: Proposal | None,
        expected: Float[np.ndarray, "h w"] | None = None,
        observations: Observations | None = None,
    ) -> None:
        views, planner, sampler = episode.views, episode.planner, episode.planner.sampler
        if proposal is not None:
            proposal = proposal.in_world(episode.frame, planner.quantity.length_power)
        new, _ = views[-1].scan.to_numpy()
        before = views[-2].cloud.to_numpy()[0] if len(views) > 1 else new[:0]
        scene, picture = self._server.scene, None if expected is None else _depth_picture(expected)
        with self._drawing:
            # Points appear at once; surfaces take longer.
            items = scene_items(before, new, [view.pose for view in views], episode.sensor)
            with self._server.atomic():
                for handle in self._handles:
                    handle.remove()
                self._handles = _draw_items(scene, items)
            observations = episode.observations_after(len(views)) if observations is None else observations
            key, *_ = view_keys(episode.key, len(views))
            answer = views[-1].answer(planner.acquisition)
            surface, imagined, kinds = _surfaces(sampler, observations, key, answer)
            with self._server.atomic():
                self._handles += [*_draw_surface(scene, surface), *_draw_imagined(scene, imagined)]
                if proposal is not None:
                    self._handles += _draw_choice(scene, planner.camera, proposal, picture)
                if self._image is not None:
                    self._image.remove()
                self._image = None
                if picture is not None:
                    self._image = self._server.gui.add_image(picture, label="depth expected there")
                self._text.content = _live_text(episode, answer, kinds, proposal)
                self._legend.content = _legend(surface, proposal, planner.quantity, episode.frame)

    def save(self, path: str | Path) -> Path:
        """Write the present scene with text and legend to one HTML file, which opens offline."""
        page, end, rest = self._server.get_scene_serializer().as_html().rpartition("</body>")
        text = "".join(f"<p>{html.escape(line.replace('**', ''))}</p>" for line in self._text.content.split("\n\n"))
        write_text(Path(path), f'{page}<aside style="{_PANEL_STYLE}">{text}{self._legend.content}</aside>{end}{rest}')
        return Path(path)

    def stop(self) -> None:
        self._server.stop()


def _surfaces(
    sampler: SurfaceSampler, observations: Observations, key: PRNGKeyArray, answer: Answer | None
) -> tuple[MeanSurface | None, list[tuple[str, Triangles]], list[tuple[str, float]]]:
    """Return the surface to show, some imagined surfaces with names, and kinds of known shapes with probabilities.

    With known parts, the imagined surfaces are the likeliest parts.

    - `answer`: see `likely_kinds`.
    """
    if isinstance(observations.hypotheses, PartHypotheses):
        parts = placed_parts(observations.hypotheses, NUM_SHOWN)
        surface = shown_surface(sampler, StepInputs(observations))
        return surface, [(part.name, (part.vertices, part.faces)) for part in parts], []
    inputs = sampler.step_inputs(observations, key)
    surface = shown_surface(sampler, inputs, answer)
    names, meshes, kinds = sampled_surfaces(sampler, inputs, key)
    imagined = [(name, triangles) for name, triangles in zip(names, meshes, strict=True) if triangles is not None]
    return surface, imagined, list(kinds.items())


def _live_text(
    episode: Episode, answer: Answer | None, kinds: list[tuple[str, float]], proposal: Proposal | None
) -> str:
    """Return Markdown with the answer, the next view (in world units) and the amount of surface seen.

    Without an answer, the text also names the kinds of known shapes.
    """
    num_views, quantity, frame = len(episode.views), episode.planner.quantity, episode.frame
    lines = list[str]()
    if answer is not None:
        words = words_of(answer.in_world(frame))
        lines += [f"**{words.question} {capital(words.found)}.**", f"{capital(words.said())}."]
    if proposal is not None:
        error = proposal.standard_error
        error_text = "" if error is None else f" ± {float(error):.2g}"
        value = f"{value_text(quantity, float(proposal.value), frame)}{error_text}"
        lines.append(f"**The next view** looks from {pose_text(proposal.pose, frame)}: {quantity.name} {value}.")
    coverage = coverage_answers(episode, None)[-1]
    lines.append(f"**{num_views} view{'s' if num_views > 1 else ''}**, {coverage.amount} of surface seen")
    lines += [kinds_text(kinds)] if kinds and answer is None else []
    return "\n\n".join(lines)


def _draw_items(scene: Any, items: Iterable[Points | Cameras]) -> list[Any]:
    handles = []
    for item in items:
        if isinstance(item, Cameras):
            for number, pose in enumerate(item.poses, start=item.first):
                handles.append(_frustum(scene, f"/cameras/view {number}", item.camera, pose, item.colour))
                # Removing the camera removes its number too.
                scene.add_label(f"/cameras/view {number}/number", str(number))
        elif len(item.places):
            settings: dict[str, Any] = {"point_size": _POINT_SIZE, "point_shape": "circle"}
            handles.append(scene.add_point_cloud(f"/{item.name}", item.places, to_rgb(item.colour), **settings))
    return handles


def _draw_surface(scene: Any, surface: MeanSurface | None) -> list[Any]:
    if surface is None:
        return []
    if isinstance(surface, PlacedShape):
        vertex_colors = np.round(255.0 * style.shape_colours(surface.measured, surface.agreed)).astype(np.uint8)
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=vertex_colors, process=False)
        name = f"/likeliest {'part' if surface.is_part else 'shape'}, {surface.caption}"
        handles = [scene.add_mesh_trimesh(name, mesh)]
        if (disputed_space := surface.disputed_space) is not None:
            glass: dict[str, Any] = {"color": to_rgb(style.DISPUTED), "opacity": 0.25}
            triangles = disputed_space.vertices, disputed_space.faces
            handles.append(scene.add_mesh_simple("/other shapes", *triangles, **glass))
        return handles
    colours = style.DEVIATION(LogNorm(*style.middle_range(surface.deviation))(surface.deviation), bytes=True)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, vertex_colors=colours, process=False)
    return [scene.add_mesh_trimesh("/surface of the mean", mesh)]


def _draw_imagined(scene: Any, surfaces: Iterable[tuple[str, Triangles]]) -> list[Any]:
    """Add surfaces to the scene, hidden at first, and return their handles."""
    settings: dict[str, Any] = {"color": to_rgb("#8fb8d8"), "opacity": 0.9, "visible": False}
    return [
        scene.add_mesh_simple(f"/imagined/{number} {shape}".rstrip(), *triangles, **settings)
        for number, (shape, triangles) in enumerate(surfaces, start=1)
    ]


def _depth_picture(depth: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Colour a depth image: near is bright, far is dark, NaN (no surface expected) is white."""
    colours = mpl.colormaps["viridis_r"].with_extremes(bad="white")
    return colours(Normalize(*colour_range(depth))(depth), bytes=True)[..., :3]


def _draw_choice(scene: Any, camera: Camera, proposal: Proposal, picture: np.ndarray | None) -> list[Any]:
    values, handles = candidate_values(proposal), []
    has_value = np.isfinite(values)
    if has_value.any():
        places = np.asarray(proposal.candidates.position)[has_value]
        colours = style.VALUE(Normalize(*colour_range(values))(values[has_value]), bytes=True)[:, :3]
        settings: dict[str, Any] = {"point_size": _CANDIDATE_SIZE, "point_shape": "circle"}
        handles.append(scene.add_point_cloud("/candidates", places, colours, **settings))
    return [*handles, _frustum(scene, "/next view", camera, proposal.pose, _NEXT_COLOUR, picture)]


def _legend(surface: MeanSurface | None, proposal: Proposal | None, quantity: Quantity, frame: Frame) -> str:
    """Return the legend of the colours as HTML."""
    marks = [("points before", style.BEFORE), ("new points, last camera", style.NEW), ("earlier cameras", style.GREY)]
    marks += [] if proposal is None else [("next view", _NEXT_COLOUR)]
    if isinstance(surface, PlacedShape):
        kind = "part" if surface.is_part else "known shape"
        marks[:0] = [
            (f"likeliest {kind}: {html.escape(surface.caption)}", style.PART),
            ("its imagined parts", style.IMAGINED),
            ("where other shapes disagree", style.DISPUTED),
        ]
    rows = [f'<div><b style="color:{colour}">&#9679;</b> {name}</div>' for name, colour in marks]
    if surface is not None and not isinstance(surface, PlacedShape):
        low, high = style.middle_range(frame.length_to_world(surface.deviation))
        rows.append(_bar(f"the surface is known to, in {frame.unit}", style.DEVIATION, f"{low:g}", f"{high:g}"))
    if proposal is not None and np.isfinite(proposal.values).any():
        ends = (value_text(quantity, value, frame) for value in colour_range(candidate_values(proposal)))
        rows.append(_bar(f"candidates: {quantity.name}", style.VALUE, *ends))
    return f'<div style="padding:0 1em 1em;font-size:.85em">{"".join(rows)}</div>'


def _bar(name: str, colours: Colormap, low: str, high: str) -> str:
    return (
        f'<div style="margin-top:.5em">{name}</div>'
        f'<div style="height:.7em;background:{style.gradient(colours)}"></div>'
        f'<div style="display:flex;justify-content:space-between"><span>{low}</span><span>{high}</span></div>'
    )


def _frustum(
    scene: Any, name: str, camera: Camera, pose: Pose, colour: str, picture: UInt8[np.ndarray, "h w 3"] | None = None
) -> Any:
    left, above, right, below = camera.edges
    return scene.add_camera_frustum(
        name,
        fov=camera.fov,
        aspect=(right - left) / (below - above),
        scale=_FRUSTUM_SIZE,
        color=to_rgb(colour),
        image=picture,
        wxyz=Rotation.from_matrix(np.asarray(pose.rotation, np.float64)).as_quat(scalar_first=True),
        position=np.asarray(pose.position, np.float64),
    )
