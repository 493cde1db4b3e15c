"""One file a task: its utility or its score."""

from jaxnbv.tasks.classification import Classifier as Classifier
from jaxnbv.tasks.classification import CrossEntropy as CrossEntropy
from jaxnbv.tasks.classification import HostClassifier as HostClassifier
from jaxnbv.tasks.classification import MixedEntropy as MixedEntropy
from jaxnbv.tasks.classification import NegativeEntropy as NegativeEntropy
from jaxnbv.tasks.classification import predict as predict
from jaxnbv.tasks.coverage import Coverage as Coverage
