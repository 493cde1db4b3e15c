"""p(f) and p(f | D): distributions over implicit surfaces."""

from jaxnbv.surfaces.base import Fields as Fields
from jaxnbv.surfaces.base import SurfaceModel as SurfaceModel
from jaxnbv.surfaces.base import SurfacePosterior as SurfacePosterior
from jaxnbv.surfaces.known_shapes import Hypothesis as Hypothesis
from jaxnbv.surfaces.known_shapes import KnownShapes as KnownShapes
from jaxnbv.surfaces.known_shapes import KnownShapesPosterior as KnownShapesPosterior
from jaxnbv.surfaces.part_hypotheses import PartHypotheses as PartHypotheses
from jaxnbv.surfaces.part_pose import ObjectPose as ObjectPose
from jaxnbv.surfaces.pathwise import FieldsAbout as FieldsAbout
from jaxnbv.surfaces.pathwise import TrigonometricPosterior as TrigonometricPosterior
from jaxnbv.surfaces.placement import AsGiven as AsGiven
from jaxnbv.surfaces.placement import FreeRotation as FreeRotation
from jaxnbv.surfaces.placement import Placement as Placement
from jaxnbv.surfaces.placement import ShapePoses as ShapePoses
from jaxnbv.surfaces.placement import Upright as Upright
from jaxnbv.surfaces.screened import ScreenedSPSR as ScreenedSPSR
from jaxnbv.surfaces.shape_bank import ShapeBank as ShapeBank
from jaxnbv.surfaces.shipped_banks import bank_poses as bank_poses
from jaxnbv.surfaces.shipped_banks import shape_bank as shape_bank
from jaxnbv.surfaces.spsr import GeometricSPSR as GeometricSPSR
from jaxnbv.surfaces.trigonometric import TrigonometricFields as TrigonometricFields
from jaxnbv.surfaces.values import OnSurface as OnSurface
from jaxnbv.surfaces.values import OutsideBoundary as OutsideBoundary
from jaxnbv.surfaces.values import SeenEmpty as SeenEmpty
from jaxnbv.surfaces.values import ValueRows as ValueRows
from jaxnbv.surfaces.values import ValueSource as ValueSource
