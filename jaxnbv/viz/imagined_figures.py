"""What a step imagined, as pictures: for the page one by one, as a figure side by side."""

from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from jaxnbv.viz.answers import number
from jaxnbv.viz.data import ReportData
from jaxnbv.viz.imagined import Expected, Imagined
from jaxnbv.viz.layout import fitted, framed
from jaxnbv.viz.render import depth_picture, depth_range, look_picture
from jaxnbv.viz.style import GREY, NEW

_TILE, _GAP, _HEAD = 1.3, 0.12, 0.28


class Tile(NamedTuple):
    """A small picture, and what it is."""

    name: str
    picture: UInt8[np.ndarray, "h w 3"]


# Of what was imagined where nothing had been seen: lighter than the points, so that its shape shows.
_UNSEEN = "#5b8fc7"


def looks(seen: Imagined) -> list[Tile]:
    """The sampled surfaces from the chosen pose, and beside them what was then seen."""
    names = seen.names or tuple(f"imagined {number}" for number in range(1, len(seen.samples) + 1))
    tiles = [Tile(name, look_picture(sample, _UNSEEN)) for name, sample in zip(names, seen.samples, strict=True)]
    if seen.seen is None:
        return tiles
    return [*tiles, Tile("then seen", look_picture(seen.seen, NEW))]


def depths(seen: Imagined) -> tuple[list[Tile], str]:
    """Expected and seen depth of the chosen camera and the runner-up, and their scale in words."""
    pairs = {"chosen": seen.chosen} | ({} if seen.runner_up is None else {"runner-up": seen.runner_up})
    images = [image for pair in pairs.values() for image in (pair.expected, pair.seen) if image is not None]
    low, high = depth_range(images)
    tiles, errors = [], []
    for name, pair in pairs.items():
        tiles.append(Tile(f"{name}: expected", depth_picture(pair.expected, low, high)))
        if pair.seen is not None:
            tiles.append(Tile(f"{name}: seen", depth_picture(pair.seen, low, high)))
            if (error := depth_error(pair)) is not None:
                errors.append(f"{number(error)} ({name})")
    scale = f"Depth from {low:.2f} (bright) to {high:.2f} scene units (dark); white: nothing there."
    return tiles, f"{scale} Median error: {', '.join(errors)}." if errors else scale


def depth_error(pair: Expected) -> float | None:
    """Median of the difference where both say something, in scene units; None where their pixels do not compare."""
    if pair.seen is None:
        return None
    # Pixels of the coarser image lie at the middle of those of the finer one.
    down, across = (max(fine // coarse, 1) for fine, coarse in zip(pair.expected.shape, pair.seen.shape, strict=True))
    expected = pair.expected[down // 2 :: down, across // 2 :: across]
    if expected.shape != pair.seen.shape or not np.isfinite(expected - pair.seen).any():
        return None
    return float(np.nanmedian(np.abs(expected - pair.seen)))


def imagined_figure(data: ReportData, index: int) -> Figure:
    """What was imagined before view `index` (from 0), in two rows."""
    seen = data.views[index].imagined
    assert seen is not None
    (below, scale), above = depths(seen), looks(seen)
    columns = max(len(above), len(below))
    width, tall = columns * (_TILE + _GAP) + _GAP, 2 * (_TILE + _HEAD) + 0.9
    figure = Figure(figsize=(width, tall))

    def share(x: float, y: float) -> tuple[float, float]:
        return x / width, y / tall

    heads = (f"What was imagined from the pose of view {index + 1} (grey: seen before)", f"Expected and seen. {scale}")
    for row, (head, tiles) in enumerate(zip(heads, (above, below), strict=True)):
        top = tall - 0.22 - row * (_TILE + _HEAD + 0.4)
        fitted(figure, *share(_GAP, top), head, 1.0 - 2 * _GAP / width, 9.0, va="center")
        for column, tile in enumerate(tiles):
            x, y = _GAP + column * (_TILE + _GAP), top - 0.16 - _TILE
            axes = figure.add_axes((*share(x, y), *share(_TILE, _TILE)))
            axes.imshow(tile.picture, interpolation="nearest")
            framed(axes, GREY, 0.6)
            fitted(figure, *share(x, y - 0.13), tile.name, _TILE / width, 8.0, va="center")
    return figure
