"""Draw the GIF docs/demo.gif, `jaxnbv demo` view by view: `python scripts/draw_demo.py`. Takes five minutes."""

import argparse
import dataclasses
from pathlib import Path

import jax
import matplotlib as mpl
import numpy as np
from draw_concepts import to_image
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

import jaxnbv as nbv
from jaxnbv.cli.play import DEMO, planner_of, sampler_of, stop_rule_of
from jaxnbv.cli.tasks import TASKS
from jaxnbv.viz.charts import set_view_axis
from jaxnbv.viz.data import ReportData, report_data
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.imagined import Tile, colour_image, image_tiles
from jaxnbv.viz.render import draw_scene, render_view
from jaxnbv.viz.style import GREY, NEW

SIZE, DPI, COLOURS = (9.2, 3.5), 120, 256
# The demo's own seed.
SEED = 2
MAX_VIEWS, MAX_RIVAL_VIEWS = 5, 10
# Milliseconds of the frames with a guess, with the answer, and at the end.
GUESS, ANSWER, END = 700, 1800, 5000


def demo_episode(seed: int, search: str, views: int) -> nbv.Episode:
    """An episode of the demo by a search of the command line, until the demo's stop rule or after `views` views."""
    task = TASKS["cross-entropy"]
    subject, stop_rule = task.demo(0, seed), stop_rule_of(task.until)
    sampler = dataclasses.replace(sampler_of("screened", False, subject.bank), grid=subject.grid)
    planner = planner_of(task.setting(), subject.acquisition, search, sampler, DEMO)
    return nbv.simulate(planner, subject.surface, subject.first, views, jax.random.key(seed), until=stop_rule)


class Film:
    """Frames of one size, each shown for a time."""

    def __init__(self, data: ReportData):
        self.data, self.stills = data, [render_view(data, index) for index in range(len(data.views))]
        self.frames: list[Image.Image] = []
        self.times: list[int] = []

    def add(self, view: int, tile: Tile, head: str, time: int, rival: int | None = None) -> None:
        """Add a frame: a picture after `view` views, and the answers so far, for the rival up to view `rival`."""
        figure = Figure(figsize=SIZE)
        figure.text(0.19, 0.95, f"after view {view}: what is known", ha="center", fontsize=10)
        panel = figure.add_axes((0.0, 0.0, 0.38, 0.93))
        draw_scene(panel, self.data, view - 1, self.stills[view - 1], inset=False)
        figure.text(0.52, 0.95, head, ha="center", fontsize=10)
        axes = figure.add_axes((0.395, 0.12, 0.25, 0.25 * SIZE[0] / SIZE[1]))
        axes.imshow(tile.picture, interpolation="bilinear")
        axes.set(xticks=[], yticks=[], xlabel=tile.name)
        axes.spines[:].set(visible=True, color=GREY)
        figure.text(0.84, 0.95, f"probability of a {self._true_name}", ha="center", fontsize=10)
        self._answers(figure.add_axes((0.72, 0.16, 0.26, 0.7)), view, view if rival is None else rival)
        self.frames.append(to_image(figure, DPI))
        self.times.append(time)

    @property
    def _true_name(self) -> str:
        (chart,) = self.data.task.charts
        return chart.names[int(np.argmax(chart.true))]

    def _answers(self, axes: Axes, num_views: int, num_rival_views: int) -> None:
        task = self.data.task
        assert task.rival is not None
        (chart,), (other,) = task.charts, task.rival.charts
        true = int(np.argmax(chart.true))
        lines = (
            (other.values[:num_rival_views], GREY, "s--", task.rival.name),
            (chart.values[:num_views], NEW, "o-", "jaxnbv"),
        )
        for values, colour, marks, name in lines:
            axes.plot(range(1, len(values) + 1), values[:, true], marks, color=colour, lw=1.8, ms=5, label=name)
        axes.axhline(chart.goal, color=GREY, lw=0.8, ls=":")
        axes.set(ylim=(0.0, 1.06))
        set_view_axis(axes, max(len(chart.values), len(other.values)))
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 0.98), ncols=2, frameon=False, fontsize=9)

    def save(self, path: Path) -> None:
        """Write the film with one palette, on a white background: Pillow looks colours up by their leading bits."""
        strip = Image.fromarray(np.concatenate([np.asarray(frame)[::3, ::3] for frame in self.frames]))
        palette = strip.quantize(COLOURS - 1, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        colours = [*palette.getpalette()[: 3 * (COLOURS - 1)], 255, 255, 255]
        frames = []
        for frame in self.frames:
            indices = np.array(frame.quantize(palette=palette, dither=Image.Dither.NONE))
            indices[(np.asarray(frame) == 255).all(axis=-1)] = COLOURS - 1
            frames.append(Image.fromarray(indices, "P"))
            frames[-1].putpalette(colours)
        frames[0].save(path, save_all=True, append_images=frames[1:], duration=self.times, loop=0, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs", help="folder of the picture")
    out: Path = parser.parse_args().out
    episode, rival = demo_episode(SEED, "halving", MAX_VIEWS), demo_episode(SEED, "farthest", MAX_RIVAL_VIEWS)
    data = report_data(episode, progress=False, rival=rival)
    views, film = data.views, Film(data)
    with mpl.rc_context(STYLE):
        for number, view in enumerate(views, start=1):
            assert view.image is not None
            if view.imagined is not None:
                for tile in image_tiles(view.imagined, None):
                    guess = Tile(tile.name.rstrip(" 0123456789") + "?", tile.picture)
                    film.add(number - 1, guess, f"imagined from view {number}", GUESS)
            scan_tile = Tile("scanned", colour_image(view.image, is_plain=True))
            film.add(number, scan_tile, f"seen from view {number}", ANSWER)
        assert data.task.rival is not None
        film.add(len(views), scan_tile, f"seen from view {len(views)}", END, len(data.task.rival.charts[0].values))
    film.save(out / "demo.gif")


if __name__ == "__main__":
    main()
