"""Shows clouds, posteriors, proposals, episodes and other objects in notebooks, as pictures with captions."""

import base64
import builtins
import functools
import html
import io
import tempfile
import textwrap
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnbv.checks import checked
from jaxnbv.errors import InputError
from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.geometry.pose import look_at
from jaxnbv.observations import Observations
from jaxnbv.planning.episode import Episode
from jaxnbv.planning.planner import Planner
from jaxnbv.planning.session import Session
from jaxnbv.search import Proposal
from jaxnbv.surfaces import SurfacePosterior
from jaxnbv.surfaces.part_hypotheses import PartHypotheses
from jaxnbv.utility import Quantity
from jaxnbv.viz.choice import draw_acquisition
from jaxnbv.viz.data import report_data
from jaxnbv.viz.figures import STYLE, overview_figure
from jaxnbv.viz.placed_shape import PlacedShape, likeliest_part
from jaxnbv.viz.render import Still, crop, draw_items, eye_beside
from jaxnbv.viz.scene import scene_items
from jaxnbv.viz.style import BEFORE, VALUE

_INCHES, _LARGE, _MAX_LETTERS, _DPI = 2.4, 4.8, 62, 110
# Viewpoint for clouds whose normals point in all directions.
_DEFAULT_EYE = np.array([0.8, 0.9, 2.2])
# Half the side of a posterior's slice, in scene units, and number of pixels along each side.
_HALF_SIDE, _PIXELS = 1.5, 48


class Drawing(NamedTuple):
    """A function that draws an object into empty axes (None for no picture), and the object's caption."""

    draw: Callable[[Axes], Any] | None
    facts: str


class Picture:
    """A PNG image that a notebook shows."""

    def __init__(self, figure: Figure, dpi: int):
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=dpi)
        self.png = file.getvalue()

    def __repr__(self) -> str:
        return f"Picture({len(self.png)} bytes of PNG)"

    def _repr_png_(self) -> bytes:
        return self.png


def html_of(value: Any) -> str:
    """Return HTML with a small picture of an object and its caption."""
    drawing = drawing_of(value)
    caption = html.escape(drawing.facts)
    if drawing.draw is None:
        return f"<div>{caption}</div>"
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_INCHES, _INCHES))
        drawing.draw(figure.add_axes((0.02, 0.02, 0.96, 0.96)))
        image = base64.b64encode(Picture(figure, _DPI).png).decode()
    return (
        f'<figure style="margin:0"><img alt="{caption}" width="{round(_INCHES * 100)}" '
        f'src="data:image/png;base64,{image}"><figcaption>{caption}</figcaption></figure>'
    )


@functools.singledispatch
def drawing_of(value: Any) -> Drawing:
    """Return how to draw an object, and its caption. Dispatches on the type of the object."""
    return Drawing(None, repr(value))


@drawing_of.register
def _(cloud: PointCloud) -> Drawing:
    if cloud.mask.ndim > 1:
        return Drawing(None, f"a batch {cloud.mask.shape[:-1]} of clouds of up to {cloud.capacity:,} points")
    points, normals = cloud.to_numpy()
    facts = f"{len(points):,} points"
    if cloud.missed is not None:
        facts += f" of {cloud.capacity:,} rays, {int(cloud.missed.sum()):,} met nothing"
    elif cloud.capacity > len(points):
        facts += f" of at most {cloud.capacity:,}"
    if not len(points):
        return Drawing(None, facts)
    size = " x ".join(f"{side:.3g}" for side in np.ptp(points, axis=0))
    return Drawing(functools.partial(_draw_shaded, points, normals), f"{facts}; box {size}")


def _draw_shaded(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], axes: Axes) -> None:
    """Draw a cloud in any unit, seen from the mean direction of its normals, bright where it faces the viewer."""
    eye = normals.mean(axis=0)
    eye = eye if np.linalg.norm(eye) > 0.2 else _DEFAULT_EYE
    rotation = np.asarray(look_at(eye).rotation)
    x, y, depth = ((points - points.mean(axis=0)) @ rotation).T
    facing = np.clip(-normals @ rotation[:, 2], 0.0, 1.0)
    order = np.argsort(-depth)
    shade = mpl.colors.LinearSegmentedColormap.from_list("shade", [BEFORE, "#cfd8e6"])(facing[order])
    axes.scatter(x[order], y[order], s=np.clip(6000.0 / len(x), 1.0, 12.0), c=shade, linewidths=0)
    axes.set(aspect="equal")
    axes.invert_yaxis()
    axes.axis("off")


@drawing_of.register
def _(posterior: SurfacePosterior) -> Drawing:
    facts = f"{type(posterior).__name__}, level {float(posterior.level):.4g}: probability of being inside at z = 0"
    return Drawing(functools.partial(_draw_slice, posterior), facts)


def _draw_slice(posterior: SurfacePosterior, axes: Axes) -> None:
    """Draw P(f < level), the probability of being inside, on the plane z = 0, with y up."""
    axis = jnp.linspace(-_HALF_SIDE, _HALF_SIDE, _PIXELS)
    x, y = jnp.meshgrid(axis, axis)
    places = jnp.stack([x.ravel(), y.ravel(), jnp.zeros(_PIXELS**2)], axis=-1)
    inside = np.asarray(posterior.probability_inside(places))
    extent = (-_HALF_SIDE, _HALF_SIDE, -_HALF_SIDE, _HALF_SIDE)
    axes.imshow(inside.reshape(_PIXELS, _PIXELS), VALUE, vmin=0, vmax=1, origin="lower", extent=extent)
    axes.axis("off")


@drawing_of.register
def _(proposal: Proposal) -> Drawing:
    where = ", ".join(f"{x:+.2f}" for x in np.asarray(proposal.pose.position).tolist())
    error = proposal.standard_error
    facts = f"look from ({where}): value {float(proposal.value):.4g}{'' if error is None else f' ± {error:.2g}'}"
    facts += f", {len(proposal.values)} candidates"
    if proposal.num_tied:
        facts += f", {proposal.num_tied} of them as good as the samples can tell"
    return Drawing(lambda axes: draw_acquisition(axes, proposal, Quantity("value", "", "")), facts)


@drawing_of.register
def _(episode: Episode) -> Drawing:
    count = len(episode.views)
    facts = f"{count} view{'s' * (count != 1)} by {episode.planner.quantity.name}, {int(episode.cloud.count):,} points"
    hypotheses = episode.views[-1].hypotheses if count else None
    part = likeliest_part(hypotheses, episode.cloud) if isinstance(hypotheses, PartHypotheses) else None
    facts += "" if part is None else f"; {part.caption}"
    draw = functools.partial(_draw_views, episode, part)
    return Drawing(draw, facts + (f"; {episode.stop_reason}" if episode.stop_reason else ""))


def _draw_views(episode: Episode, part: PlacedShape | None, axes: Axes) -> None:
    poses = [view.pose for view in episode.views]
    extent = max(1.8, *(float(np.linalg.norm(pose.position)) for pose in poses))
    still = Still(eye_beside(poses[-1]), part, 400, extent)
    points, new = episode.cloud.to_numpy()[0], episode.views[-1].scan.to_numpy()[0]
    content = draw_items(axes, still, scene_items(points, new, poses, episode.planner.camera), 0.8)
    crop(axes, still, content)


@drawing_of.register
def _(observations: Observations) -> Drawing:
    views, cloud = int(observations.num_views), drawing_of(observations.cloud)
    nodes = observations.empty_nodes
    empty = "" if nodes is None else f", {float(np.mean(nodes)):.0%} of the grid seen empty"
    return Drawing(cloud.draw, f"{views} view{'s' * (views != 1)}{empty}; {cloud.facts}")


@drawing_of.register
def _(session: Session) -> Drawing:
    if not session.views:
        return Drawing(None, "no image yet")
    drawing, next_view = drawing_of(session.episode), session.next_view
    value = "" if next_view is None else f"; the next view is worth {next_view.value:.4g}"
    return Drawing(drawing.draw, drawing.facts + value)


@drawing_of.register
def _(planner: Planner) -> Drawing:
    sampler, search = planner.sampler, type(planner.search).__name__
    by = f" over {sampler.num_samples} samples of {type(sampler.model).__name__}" * planner.search.uses_samples
    return Drawing(None, f"{search} by {planner.quantity.name}{by}; at most {planner.capacity:,} points are kept")


@checked
def show(
    shown: PointCloud | Observations | SurfacePosterior | Proposal | Episode | Session | Planner, progress: bool = True
) -> Picture:
    """Return a large picture for a notebook. Outside notebooks, also save it as PNG and print its path.

    For an episode or a session it shows all views, with the surface and the candidates of each.

    **Raises:** `ValueError` for a planner, a batch of clouds, or a value without points: these have no picture.
    """
    picture = _large(shown, progress)
    if not hasattr(builtins, "__IPYTHON__"):
        with tempfile.NamedTemporaryFile(prefix="jaxnbv-", suffix=".png", delete=False) as file:
            file.write(picture.png)
        print(f"no notebook shows the picture; it is saved as {file.name}")
    return picture


def _large(value: Any, progress: bool) -> Picture:
    episode = value.episode if isinstance(value, Session) and value.views else value
    with mpl.rc_context(STYLE):
        if isinstance(episode, Episode):
            data = report_data(episode, progress=progress, imagine=False)
            return Picture(overview_figure(data), 80)
        drawing = drawing_of(value)
        if drawing.draw is None:
            raise InputError(f"this has no picture: {drawing.facts}. Give one thing that holds points")
        figure = Figure(figsize=(_LARGE, _LARGE))
        figure.text(0.5, 0.02, "\n".join(textwrap.wrap(drawing.facts, _MAX_LETTERS)), ha="center", fontsize=8)
        drawing.draw(figure.add_axes((0.02, 0.1, 0.96, 0.88)))
        return Picture(figure, _DPI)
