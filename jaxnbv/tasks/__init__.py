"""Tasks. Each file has the utility or acquisition of a task, and the task's answer."""

from jaxnbv.tasks.classification import ClassAcquisition as ClassAcquisition
from jaxnbv.tasks.classification import Classifier as Classifier
from jaxnbv.tasks.classification import CrossEntropy as CrossEntropy
from jaxnbv.tasks.classification import EntropyReduction as EntropyReduction
from jaxnbv.tasks.classification import MixedEntropy as MixedEntropy
from jaxnbv.tasks.coverage import Coverage as Coverage
from jaxnbv.tasks.coverage import NewSurface as NewSurface
from jaxnbv.tasks.diffusion import HeatProblem as HeatProblem
from jaxnbv.tasks.heat import Coldest as Coldest
from jaxnbv.tasks.heat import ColdestPoint as ColdestPoint
from jaxnbv.tasks.heat import body_temperature as body_temperature
from jaxnbv.tasks.heat import coldest_point as coldest_point
from jaxnbv.tasks.host import HostClassifier as HostClassifier
from jaxnbv.tasks.host import HostSegmenter as HostSegmenter
from jaxnbv.tasks.identification import Identify as Identify
from jaxnbv.tasks.segmentation import Segmenter as Segmenter
from jaxnbv.tasks.segmentation import SoftPartCount as SoftPartCount
from jaxnbv.tasks.segmentation import part_counts as part_counts
