"""A GIF of the simulated arm: its motion, and the points that it has scanned so far."""

from pathlib import Path

import numpy as np
from arm_simulator import ARM, HOUSING, SCENE, Arm
from PIL import Image, ImageDraw, ImageFont

import jaxnbv as nbv

_SIZE, _CLOSE_UP = (340, 420), (340, 220)
_EYE = np.array([1.15, -1.0, 0.75])
_BLUE = np.array([0.1, 0.35, 0.85])
# Frames of a motion. Milliseconds of each, and of the image at its end.
_FRAMES, _MOVING, _STANDING = 7, 90, 700


class Frames:
    """Frames of a film of an arm. The object is at `place`."""

    def __init__(self, arm: Arm, place: np.ndarray):
        self._arm, self._place = arm, place
        self._points = np.zeros((0, 3))
        self._images: list[Image.Image] = []
        self._durations: list[int] = []

    def draw(self, session: nbv.Session, way: list[np.ndarray]) -> None:
        """Add the motion to the latest image, and that image."""
        number = len(session.views)
        stops = np.unique(np.linspace(0, len(way) - 1, _FRAMES).astype(int))
        for stop in stops:
            self._add(way[stop], f"to image {number}", _MOVING)
        self._points = nbv.viz.scanned_cloud(session.episode).to_numpy()[0]
        self._add(way[-1], f"image {number}: {len(self._points):,} points", _STANDING)

    def save(self, path: Path) -> None:
        """Write the film."""
        # Small copies of all frames give the palette.
        small = [np.asarray(image.resize((160, 85))) for image in self._images]
        palette = Image.fromarray(np.concatenate(small)).quantize(200)
        first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in self._images)
        durations = [*self._durations[:-1], 3 * _STANDING]
        first.save(path, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)

    def _add(self, joints: np.ndarray, caption: str, duration: int) -> None:
        middle = self._place + np.array([0.0, 0.0, 0.06])
        target, near = 0.6 * self._place + [0.0, 0.0, 0.26], middle + 0.45 * (_EYE - middle)
        whole = self._shot(joints, _EYE, target, nbv.Camera(0.68, *_SIZE), (SCENE, HOUSING, ARM))
        close = self._shot(joints, near, middle, nbv.Camera(0.48, *_CLOSE_UP), (SCENE,))
        gap = np.ones((_SIZE[0], 4, 3))
        image = Image.fromarray((255 * np.concatenate([whole, gap, close], axis=1)).astype(np.uint8))
        text = f"{caption}   {self._arm.seconds:.0f} s of motion"
        ImageDraw.Draw(image).text((10, 8), text, fill=(60, 60, 60), font=ImageFont.load_default(14))
        self._images.append(image)
        self._durations.append(duration)

    def _shot(
        self, joints: np.ndarray, eye: np.ndarray, target: np.ndarray, camera: nbv.Camera, groups: tuple[int, ...]
    ) -> np.ndarray:
        """A picture with the visible scanned points."""
        pose = nbv.look_at(eye, target, up=(0.0, 0.0, 1.0))
        image, depth = self._arm.picture(joints, camera, pose, groups)
        local = (self._points - np.asarray(pose.position)) @ np.asarray(pose.rotation)
        pixels = local / local[:, 2:] @ camera.intrinsics.T
        columns, rows = np.round(pixels[:, :2]).astype(int).T
        inside = (rows >= 0) & (rows < camera.height) & (columns >= 0) & (columns < camera.width)
        rows, columns, ahead = rows[inside], columns[inside], local[inside, 2]
        behind = (depth[rows, columns] > 0) & (ahead > depth[rows, columns] + 0.004)
        rows, columns = rows[~behind], columns[~behind]
        image[rows, columns] = 0.35 * image[rows, columns] + 0.65 * _BLUE
        return image
