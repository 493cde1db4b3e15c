"""Draw the pictures of docs/concepts.md, one small step of the demo object: `python scripts/draw_concepts.py`."""

import argparse
import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import jaxnbv as nbv
from jaxnbv.acquisition import ImaginedView, context_of
from jaxnbv.geometry.neighbours import nearest_squared_distance
from jaxnbv.studies.scenes import Split, demo_object, hidden_view, pyramid_scene
from jaxnbv.surfaces.known_shapes import kind_of
from jaxnbv.viz.choice import draw_acquisition
from jaxnbv.viz.figures import STYLE
from jaxnbv.viz.imagined import colour_image, shaded_image
from jaxnbv.viz.render import Still, crop, draw_items, eye_beside
from jaxnbv.viz.scene import scene_items
from jaxnbv.viz.style import BEFORE, GREY, INK, NEW, VALUE

NUM_SAMPLES = 4
PIXELS = 160


def to_image(figure: Figure, dpi: int) -> Image.Image:
    """A figure as an image."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")


def save(figure: Figure, path: Path) -> None:
    """Write a figure with few colours, which makes the file small."""
    to_image(figure, 170).quantize(255, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


def draw_posterior(
    planner: nbv.Planner, observations: nbv.Observations, surfaces: nbv.scanning.GridSurface, scene: nbv.SDFSurface
) -> Figure:
    """Draw the scan of one view, outlines of samples on the plane x = 0, and the probability of being inside there."""
    axis = np.asarray(planner.sampler.grid.axis)
    middle = len(axis) // 2
    # Only every second node, since variances take long.
    y, z = np.meshgrid(axis[::2], axis[::2], indexing="ij")
    plane = jnp.asarray(np.stack([np.full(y.size, axis[middle]), y.ravel(), z.ravel()], axis=1))
    posterior = planner.sampler.posterior(observations)
    inside = np.asarray(posterior.probability_inside(plane)).reshape(y.shape)
    truth = np.asarray(scene.sdf(plane)).reshape(y.shape)
    figure = Figure(figsize=(9.6, 3.5))
    first, second, third = (figure.add_axes((left, 0.02, 0.32, 0.86)) for left in (0.0, 0.34, 0.67))
    pose = observations.poses.rows[0]
    still = Still(eye_beside(pose), None, 500, 2.5)
    points, _ = observations.cloud.to_numpy()
    crop(first, still, draw_items(first, still, scene_items(points[:0], points, [pose], planner.camera)))
    first.axis("off")
    for sample in np.asarray(surfaces.values[:NUM_SAMPLES, middle]):
        second.contour(axis, axis, sample, levels=[0.0], colors=[BEFORE], linewidths=0.9, alpha=0.75)
    extent = (axis[0], axis[-2]) * 2
    third.imshow(inside, VALUE, vmin=0, vmax=1, origin="lower", extent=extent, interpolation="bilinear")
    heads = "D, what one view saw", f"cross-section of {NUM_SAMPLES} samples", "probability of being inside"
    for panel, head in zip((first, second, third), heads, strict=True):
        figure.text(panel.get_position().x0 + 0.01, 0.94, head, fontsize=10)
    is_near = np.abs(points[:, 0] - axis[middle]) < 0.03
    for panel in (second, third):
        panel.contour(axis[::2], axis[::2], truth, levels=[0.0], colors=[GREY], linewidths=1.0, linestyles=":")
        panel.scatter(points[is_near, 2], points[is_near, 1], s=5.0, color=NEW, linewidths=0, zorder=5)
        panel.set(xlim=(-1.5, 1.5), ylim=(-1.35, 1.35), aspect="equal")
        panel.axis("off")
    return figure


def draw_utility(
    planner: nbv.Planner,
    observations: nbv.Observations,
    surfaces: nbv.scanning.GridSurface,
    proposal: nbv.search.Proposal,
) -> Figure:
    """Draw imagined scans of the best candidate and of one of the worst tenth, coloured by the worth of each point."""
    order = np.argsort(np.asarray(proposal.values))
    indices = np.array([order[-1], order[len(order) // 10]])
    poses = proposal.candidates[jnp.asarray(indices)]
    camera = dataclasses.replace(planner.camera, height=PIXELS, width=PIXELS)
    few = jax.tree.map(lambda rows: rows[:NUM_SAMPLES], surfaces)
    fine, coarse = (nbv.scanning.scan_samples(few, one, poses) for one in (camera, planner.camera))
    context = context_of(planner.acquisition, observations)
    figure = Figure(figsize=(9.6, 5.2))
    highest = 0.0
    squares = np.zeros((2, NUM_SAMPLES, PIXELS**2))
    for row in range(2):
        for column in range(NUM_SAMPLES):
            squares[row, column] = nearest_squared_distance(fine.points[column, row], observations.cloud)
            highest = max(highest, float(np.quantile(squares[row, column][np.asarray(fine.mask[column, row])], 0.98)))
    for row, name in enumerate(("the chosen view", "a poor view")):
        expected = float(proposal.values[indices[row]])
        figure.text(
            0.012,
            0.955 - 0.49 * row,
            f"{name}: {expected:.0f} expected, of {planner.sampler.num_samples} samples",
            color=INK,
            fontsize=10,
        )
        for column in range(NUM_SAMPLES):
            axes = figure.add_axes((0.01 + 0.222 * column, 0.55 - 0.49 * row, 0.21, 0.385))
            mask = np.asarray(fine.mask[column, row])
            normals = np.asarray(fine.normals[column, row])
            right, down, forward = np.asarray(poses.rotation[row]).T
            light = -forward - 0.5 * right - 0.7 * down
            lit = 0.75 + 0.3 * np.clip(normals @ (light / np.linalg.norm(light)), -0.4, 1.0)
            colours = np.ones((PIXELS**2, 3))
            colours[mask] = (VALUE(np.clip(squares[row, column] / highest, 0, 1))[:, :3] * lit[:, None])[mask]
            axes.imshow(np.clip(colours, 0, 1).reshape(PIXELS, PIXELS, 3), interpolation="bilinear")
            axes.set(xticks=[], yticks=[])
            coarse_scan = jax.tree.map(lambda rows, i=(column, row): rows[i], coarse)
            worth = float(planner.acquisition.score(context, ImaginedView(coarse_scan, planner.camera, poses[row])))
            axes.set_xlabel(f"worth {worth:.0f}", labelpad=2)
    bar = figure.add_axes((0.91, 0.2, 0.014, 0.55))
    scale = mpl.cm.ScalarMappable(mpl.colors.Normalize(0.0, highest), VALUE)
    figure.colorbar(scale, cax=bar).set_label("squared distance to D")
    return figure


def draw_search(proposals: dict[str, nbv.search.Proposal], quantities: dict[str, nbv.Quantity]) -> Figure:
    """Draw a map of the sphere of directions for each search."""
    figure = Figure(figsize=(9.6, 2.3))
    for index, (name, proposal) in enumerate(proposals.items()):
        axes = figure.add_axes((0.005 + 0.333 * index, 0.02, 0.323, 0.76))
        draw_acquisition(axes, proposal, quantities[name])
        axes.set_title(f"{name}: {quantities[name].name}", loc="center", fontsize=8)
    return figure


def draw_known() -> Figure:
    """Draw bases imagined after a view that shows none of the base, without and with known shapes."""
    pyramid = pyramid_scene(Split.VALIDATION, 2)
    first = hidden_view(pyramid, jax.random.key(0))
    plain = dataclasses.replace(nbv.SurfaceSampler.preset("screened", solid=True), grid=nbv.Grid(100), num_samples=16)
    with_bank = plain.with_bank(nbv.shape_bank("pyramid"), nbv.surfaces.FreeRotation())
    planner = nbv.Planner(nbv.Coverage(), sampler=plain)
    scan = nbv.scan(nbv.SDFSurface(pyramid), planner.camera, first)
    observations = planner.init(first, nbv.SensorNoise()(scan, jax.random.key(0)))
    below = nbv.look_at(np.asarray(pyramid.solid.rotation) @ (1.6, 1.0, -5.0))
    camera = nbv.Camera(height=PIXELS, width=PIXELS)
    posterior, key = with_bank.posterior(observations), jax.random.key(0)
    names = [kind_of(name) for name in posterior.names_of_samples(key, with_bank.num_samples)]
    sample_indices = [names.index(name) for name in dict.fromkeys(names)][:NUM_SAMPLES]
    rows = (
        ("by the Gaussian process", plain.sample(observations, key), range(NUM_SAMPLES), [""] * NUM_SAMPLES),
        (
            "with known shapes",
            with_bank.sample(observations, key, posterior),
            sample_indices,
            [names[index] for index in sample_indices],
        ),
    )
    cloud = observations.cloud.to_numpy()[0]
    figure = Figure(figsize=(9.6, 4.6))
    for row, (head, surfaces, indices, labels) in enumerate(rows):
        figure.text(0.012, 0.955 - 0.49 * row, head, color=INK, fontsize=10)
        scans = nbv.scanning.scan_samples(surfaces, camera, below[None])
        for column, (index, label) in enumerate(zip(indices, labels, strict=True)):
            axes = figure.add_axes((0.01 + 0.2 * column, 0.55 - 0.49 * row, 0.19, 0.385))
            image = shaded_image(jax.tree.map(lambda leaf, i=index: leaf[i, 0], scans), camera, below, cloud)
            axes.imshow(colour_image(image, "#5b8fc7"))
            axes.axis("off")
            axes.text(0.5, -0.02, label, ha="center", va="top", transform=axes.transAxes)
    axes = figure.add_axes((0.81, 0.305, 0.18, 0.385))
    true_scan = nbv.scan(nbv.SDFSurface(pyramid), camera, below)
    axes.imshow(colour_image(shaded_image(true_scan, camera, below, cloud), NEW))
    axes.axis("off")
    axes.text(0.5, -0.02, "the truth", ha="center", va="top", transform=axes.transAxes)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    folder = parser.parse_args().out
    scene = demo_object()
    model = nbv.ScreenedSPSR(nbv.GeometricSPSR((0.02, 0.06), (0.2, 0.25), truncation=16))
    camera = nbv.Camera(height=32, width=32)
    sampler = nbv.SurfaceSampler(model, grid=nbv.Grid(72), num_samples=8)
    planner = nbv.Planner(nbv.Coverage(), camera=camera, sampler=sampler, capacity=1024)
    first, noise = nbv.look_at((0.8, 0.9, 2.2)), nbv.SensorNoise()
    scan_key, sample_key, search_key = jax.random.split(jax.random.key(0), 3)
    observations = planner.init(first, noise(nbv.scan(scene, planner.camera, first), scan_key))
    inputs = planner.step_inputs(observations, sample_key)
    surfaces, proposal = inputs.surfaces, planner.choose(inputs, search_key)
    with mpl.rc_context(STYLE):
        save(draw_posterior(planner, observations, surfaces, scene), folder / "concepts_posterior.png")
        save(draw_utility(planner, observations, surfaces, proposal), folder / "concepts_utility.png")
        searches = (nbv.DiscreteSearch(), nbv.search.UncertaintyView(), nbv.FarthestView())
        planners = {type(search).__name__: dataclasses.replace(planner, search=search) for search in searches}
        proposals = {name: one.choose(inputs, search_key) for name, one in planners.items()}
        quantities = {name: one.quantity for name, one in planners.items()}
        save(draw_search(proposals, quantities), folder / "concepts_search.png")
        save(draw_known(), folder / "concepts_known.png")


if __name__ == "__main__":
    main()
