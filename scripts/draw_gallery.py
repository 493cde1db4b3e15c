"""Draw docs/gallery.png, the posteriors of eight shipped objects after four views, and docs/hero.png, one step of one
of them: `python scripts/draw_gallery.py`. Takes fifteen minutes on two cores."""

import argparse
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
from draw_concepts import save
from draw_demo import SEED, demo_episode
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from tqdm import tqdm

import jaxnbv as nbv
from jaxnbv.scanning import SDFSurface, Surface
from jaxnbv.scanning.metrics import truth_points
from jaxnbv.scanning.sensors import USUAL_SETTING, fit_distance
from jaxnbv.search import SphereCandidates
from jaxnbv.studies.scenes import Split, demo_object, household_scene, part_scene, truck_scene
from jaxnbv.viz.choice import draw_acquisition
from jaxnbv.viz.data import ReportData, report_data
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.imagined import image_tiles
from jaxnbv.viz.render import draw_scene, render_view
from jaxnbv.viz.style import GREY

VIEWS, RAYS, CANDIDATES = 4, 48, 60
FIRST = nbv.look_at((0.8, 0.9, 2.2))


def objects() -> dict[str, Surface]:
    """The objects of the gallery by name."""
    return {
        "mug": demo_object(),
        "truck with a chair": SDFSurface(truck_scene(Split.TEST, 2)),
        "sofa": SDFSurface(household_scene(Split.TEST, 7)),
        "toilet": SDFSurface(household_scene(Split.TEST, 9)),
        "bathtub": SDFSurface(household_scene(Split.TEST, 0)),
        "guitar": SDFSurface(part_scene(Split.TEST, 4).solid),
        "lamp": SDFSurface(part_scene(Split.TEST, 5).solid),
        "motorbike": SDFSurface(part_scene(Split.TEST, 7).solid),
    }


def episode_of(surface: Surface, views: int) -> nbv.Episode:
    """An episode of an object that fits into the image."""
    points = truth_points(surface, jax.random.key(0))
    setting = fit_distance(USUAL_SETTING, float(np.linalg.norm(points, axis=1).max()))
    camera = setting.camera.resized(RAYS, RAYS)
    search = nbv.DiscreteSearch(SphereCandidates(CANDIDATES, setting.radius))
    sampler = nbv.SurfaceSampler(grid=nbv.Grid(72), num_samples=8)
    planner = nbv.Planner(nbv.Coverage(), search, camera, sampler, capacity=4096)
    first = nbv.look_at(setting.radius * FIRST.position / np.linalg.norm(FIRST.position))
    return nbv.simulate(planner, surface, first, views=views, key=jax.random.key(0))


def draw_gallery(figure: Figure, columns: int = 4) -> None:
    """Draw the posterior mean of each object after its last view."""
    surfaces = objects()
    rows = -(-len(surfaces) // columns)
    for index, (name, surface) in enumerate(tqdm(surfaces.items(), "objects")):
        episode = episode_of(surface, VIEWS)
        data = report_data(episode, progress=False, imagine=False)
        row, column = divmod(index, columns)
        bottom = 1.0 - (row + 1) / rows
        axes = figure.add_axes((column / columns, bottom + 0.08 / rows, 1.0 / columns, 0.92 / rows))
        draw_scene(axes, data, VIEWS - 1, render_view(data, VIEWS - 1), weight=0.8, inset=False)
        text = f"{name}, {data.views[-1].coverage.amount} covered"
        figure.text((column + 0.5) / columns, bottom + 0.04 / rows, text, ha="center", va="center", fontsize=9)


def draw_hero(figure: Figure) -> None:
    """Draw one step: the cloud, the samples, the values of candidates, the scan from the best, and the answer."""
    episode = demo_episode(SEED, "halving", 2)
    data: ReportData = report_data(episode, progress=False)
    sketch, proposal = data.views[1].imagined, data.views[1].proposal
    assert sketch is not None
    heads = (
        ("a truck: what does it carry?", "purple: shapes that it may have"),
        ("what may be there", "four guesses; blue: not seen yet"),
        ("what each view is worth", "purple: may change the answer"),
        ("the next view, and the answer", data.task.answer_text.partition(". ")[0]),
    )
    widths = (3.0, 2.6, 2.6, 3.0)
    total, left = sum(widths), 0.0
    for place, ((head, below), width) in enumerate(zip(heads, widths, strict=True)):
        x, w = left / total, width / total
        figure.text(x + 0.5 * w, 0.96, head, ha="center", va="center", fontsize=12)
        figure.text(x + 0.5 * w, 0.875, below, ha="center", va="center", color=GREY, fontsize=10.5)
        if place in (0, 3):
            index = 0 if place == 0 else 1
            draw_scene(figure.add_axes((x, 0.0, w, 0.86)), data, index, render_view(data, index), inset=False)
        elif place == 1:
            for number, tile in enumerate(image_tiles(sketch, None)):
                down, across = divmod(number, 2)
                box = (x + (0.04 + 0.48 * across) * w, 0.43 - 0.42 * down, 0.44 * w, 0.4)
                _tile(figure.add_axes(box), tile.picture)
        else:
            draw_acquisition(figure.add_axes((x + 0.02 * w, 0.2, 0.96 * w, 0.55)), proposal, data.quantity)
        left += width


def _tile(axes: Axes, picture: np.ndarray) -> None:
    axes.imshow(picture, interpolation="bilinear")
    axes.set(xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set(visible=True, color=GREY, linewidth=0.6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=["hero", "gallery"], help="which; default: both")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs", help="folder of the pictures")
    arguments = parser.parse_args()
    out: Path = arguments.out
    with mpl.rc_context(STYLE):
        for name, size, draw in (("hero", (11.2, 3.2), draw_hero), ("gallery", (10.4, 5.6), draw_gallery)):
            if name in arguments.names:
                figure = Figure(figsize=size)
                draw(figure)
                save(figure, out / f"{name}.png")


if __name__ == "__main__":
    main()
