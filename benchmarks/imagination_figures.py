"""Pictures for `sampler.py`: imagined surfaces beside the true one, and reliability diagrams."""

import math
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import jaxnbv as nbv
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.style import BEFORE, GREY, INK, LINE, NEW

TINT = "#f0a45c"


def picture(surface: nbv.scanning.Surface, eye: nbv.Pose, cloud: nbv.PointCloud, pixels: int = 440) -> np.ndarray:
    """The surface lit from beside the eye, tinted near scanned points, as RGBA. Four rays a pixel."""
    camera = nbv.Camera(2.0 * math.atan(1.9 / 11.0), 2 * pixels, 2 * pixels)
    view = nbv.scan(surface, camera, eye)
    normals = np.asarray(view.normals)
    is_near = np.asarray(nearest_squared_distance(view.points, cloud)) < 0.05**2
    right, down, forward = np.asarray(eye.rotation).T
    light = -forward - 0.6 * right - 0.8 * down
    brightness = 0.62 + 0.44 * np.clip(normals @ (light / np.linalg.norm(light)), -0.5, 1.0)
    colours = np.where(is_near[:, None], mpl.colors.to_rgb(TINT), mpl.colors.to_rgb(LINE)) * brightness[:, None]
    colours[~np.asarray(view.mask)] = 1.0
    image = np.concatenate([np.clip(colours, 0.0, 1.0), np.asarray(view.mask, float)[:, None]], axis=1)
    return image.reshape(pixels, 2, pixels, 2, 4).mean(axis=(1, 3))


def crop(images: list[np.ndarray]) -> tuple[slice, slice]:
    """The rows and columns that any of the pictures needs, except for stray specks."""
    opacity = np.mean([image[..., 3] for image in images], axis=0)
    spans = []
    for axis in (1, 0):
        (indices,) = np.nonzero(opacity.sum(axis=axis) > 0.5)
        spans.append(slice(max(indices[0] - 6, 0), indices[-1] + 7))
    return spans[0], spans[1]


def draw_samples(
    path: Path, scene: nbv.scanning.Surface, view: tuple, planners: dict[str, nbv.Planner], key: jax.Array
) -> None:
    """Draw the true surface and four samples of each of two models after one view, seen from the side of the view."""
    pose, scan = view
    direction, up = np.asarray(pose.position) / 2.5, np.array([0.0, 1.0, 0.0])
    across = np.cross(up, direction) / max(float(np.linalg.norm(np.cross(up, direction))), 1e-6)
    eye = nbv.look_at(11.0 * (math.cos(1.15) * direction + math.sin(1.15) * across + 0.25 * up))
    images = [picture(scene, eye, scan)]
    for planner in planners.values():
        surfaces = planner.sampler.sample(planner.init(pose, scan), key)
        images += [picture(jax.tree.map(lambda leaf, i=i: leaf[i], surfaces), eye, scan) for i in range(4)]
    rows, columns = crop(images)
    # Inches: height of a small picture and of a heading. The true surface is as high as both rows.
    tall, head = 1.75, 0.3
    wide = tall * (columns.stop - columns.start) / (rows.stop - rows.start)
    large = 2 * tall + head
    width, height = large * wide / tall + 0.2 + 4 * (wide + 0.1), large + head
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height))

        def place(image: np.ndarray, left: float, bottom: float, scale: float) -> None:
            axes = figure.add_axes((left / width, bottom / height, scale * wide / width, scale * tall / height))
            axes.imshow(image[rows, columns, :3], interpolation="bilinear", aspect="auto")
            axes.axis("off")

        def write(left: float, bottom: float, text: str) -> None:
            figure.text(left / width, bottom / height, text, va="bottom", fontsize=9, color=INK)

        place(images[0], 0.0, 0.0, large / tall)
        write(0.06, large + 0.06, "the object, and what one view saw of it")
        for row, name in enumerate(planners):
            left, bottom = large * wide / tall + 0.2, (1 - row) * (tall + head)
            write(left, bottom + tall + 0.06, f"imagined from this view: {name}")
            for column in range(4):
                place(images[1 + 4 * row + column], left + column * (wide + 0.1), bottom, 1.0)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.set_dpi(150)
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        # Few colours are enough for two hues, and make the file small.
        Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB").quantize(96, dither=Image.Dither.NONE).save(
            path, optimize=True
        )


def draw_reliability(path: Path, rows: dict[tuple[str, int, str], list[dict]], names: tuple[str, str]) -> None:
    """Draw observed frequency against forecast probability of being inside, over all runs. One panel a number of views.

    Areas of the marks are proportional to the numbers of nodes.
    """
    views = len(next(iter(rows.values())))
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(3.4 * views, 3.9), layout="constrained")
        panels = figure.subplots(1, views, sharey=True, squeeze=False)[0]
        for index, axes in enumerate(panels):
            axes.plot([0, 1], [0, 1], color=GREY, linewidth=0.8, linestyle=":")
            for name, colour in zip(names, (BEFORE, NEW), strict=True):
                runs = [run[index]["reliability"] for (_, _, model), run in rows.items() if model == name]
                forecast, observed, fraction = pool_bins([run for run in runs if run is not None])
                axes.plot(forecast, observed, color=colour, linewidth=1.2, label=name)
                axes.scatter(forecast, observed, s=4.0 + 160.0 * fraction, color=colour)
            axes.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), aspect="equal", xlabel="P(inside) imagined")
            axes.set_title(f"after {index + 1} view{'s' if index else ''}", fontsize=9)
        panels[0].set_ylabel("share truly inside")
        panels[0].legend(frameon=False, fontsize=8)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150, bbox_inches="tight")


def pool_bins(runs: list[dict]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean forecast, share inside and share of the nodes, for each bin of some runs that is not empty."""
    nodes = np.array([run["nodes"] for run in runs])
    is_filled = nodes.sum(axis=0) > 0
    forecast, observed = (
        np.sum(nodes * np.array([[mean or 0.0 for mean in run[key]] for run in runs]), axis=0)[is_filled]
        / nodes.sum(axis=0)[is_filled]
        for key in ("forecast", "observed")
    )
    return forecast, observed, nodes.sum(axis=0)[is_filled] / nodes.sum()
