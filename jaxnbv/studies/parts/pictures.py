"""The parts that have been found, view by view and method by method."""

from collections.abc import Sequence
from typing import cast

import jax
import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from jaxnbv.geometry.cloud import PointCloud
from jaxnbv.scanning import TriangleMesh
from jaxnbv.scanning.metrics import true_mesh
from jaxnbv.studies.engine.measures import Record
from jaxnbv.studies.engine.pictures import Tiles, across, draw_on, say, still_of
from jaxnbv.studies.parts.discovery import TARGET, PartDiscoveryStudy
from jaxnbv.viz.style import GREY, SERIES

# Points of the true surface that are drawn.
_DENSE = 8000


def tiles(study: PartDiscoveryStudy, record: Record, methods: Sequence[str], pixels: int) -> Tiles:
    """The cloud so far over the true shape, coloured by the part that the segmenter says; beneath it how many parts
    have N_target = 60 points. A method ends once every part has 100."""
    scene, held = study.scene(record["scene"]), record["methods"]
    asked, segmenter = np.asarray(study.truth(scene)), study.segmenter_of(scene)
    own, point = [SERIES[part % len(SERIES)] for part in range(len(asked))], jnp.zeros((1, 3))
    labels = jax.eval_shape(segmenter, PointCloud(point, point, jnp.zeros(1, bool))).shape[1]
    colours = np.tile(mpl.colors.to_rgb(GREY), (labels, 1))
    colours[asked] = mpl.colors.to_rgba_array(own)[:, :3]
    mesh = cast(TriangleMesh, true_mesh(scene.surface))
    points = mesh.sample_points(jax.random.key(0), _DENSE)
    of = np.asarray(study.true_parts(scene, jnp.asarray(points, jnp.float32)))
    still = still_of(mesh, across(study, record), pixels)
    known = {method: study.seen(scene, held[method]) for method in methods}

    def tile(axes: Axes, method: str, view: int) -> None:
        fed, predicted = segmenter.predict(known[method][view][1].cloud)
        mask = np.asarray(fed.mask)
        draw_on(axes, still, np.asarray(fed.points)[mask], colours[np.asarray(predicted)[mask]])
        found = sum(count >= TARGET for count in held[method]["counts"][view])
        say(axes, f"{found} of {len(asked)} parts", found == len(asked))

    marks = {name: {"marker": "o", "color": colour} for name, colour in zip(record["parts"], own, strict=True)}
    caption = f"Points: the part that the segmenter says. Beneath: parts with {TARGET} points. View 1 is given."
    return Tiles(caption, tile, lambda axes: draw_on(axes, still, points, colours[of]), marks=marks)
