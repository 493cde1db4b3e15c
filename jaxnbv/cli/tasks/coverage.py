"""The task that asks for the object's shape."""

import jaxnbv as nbv
from jaxnbv.cli.tasks.base import Subject, Task, default_first_pose


class CoverageTask(Task):
    name = "coverage"
    about = "its shape"
    example = "a mug"

    def acquisition(self, mesh: "nbv.TriangleMesh", camera: "nbv.Camera", first: "nbv.Pose") -> "nbv.Acquisition":
        return nbv.NewSurface()

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return a mug, whatever `scene` and `seed` are."""
        from jaxnbv.studies.scenes import demo_object

        return Subject("mug", demo_object(), nbv.NewSurface(), default_first_pose())
