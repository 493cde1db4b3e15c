"""The task that asks for the object's shape."""

from typing import TYPE_CHECKING

from jaxnbv.cli.tasks.base import Subject, Task, default_first_pose

if TYPE_CHECKING:
    from jaxnbv.acquisition import Acquisition
    from jaxnbv.geometry.camera import Camera
    from jaxnbv.geometry.pose import Pose
    from jaxnbv.scanning import TriangleMesh


class CoverageTask(Task):
    name = "coverage"
    about = "its shape"
    example = "a mug"

    def acquisition(self, mesh: "TriangleMesh", camera: "Camera", first: "Pose") -> "Acquisition":
        from jaxnbv.tasks import NewSurface

        return NewSurface()

    @classmethod
    def demo(cls, scene: int, seed: int) -> Subject:
        """Return a mug, whatever `scene` and `seed` are."""
        from jaxnbv.studies.scenes import demo_object
        from jaxnbv.tasks import NewSurface

        return Subject("mug", demo_object(), NewSurface(), default_first_pose())
