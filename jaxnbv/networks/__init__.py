"""Networks on clouds: PointNet++, small invariant classifiers, a small segmenter, and checkpoints."""

from jaxnbv.networks.categories import CATEGORIES as CATEGORIES
from jaxnbv.networks.categories import Category as Category
from jaxnbv.networks.categories import category_index as category_index
from jaxnbv.networks.categories import part_mask as part_mask
from jaxnbv.networks.checkpoints import load_checkpoint as load_checkpoint
from jaxnbv.networks.checkpoints import save_checkpoint as save_checkpoint
from jaxnbv.networks.clouds import CloudClassifier as CloudClassifier
from jaxnbv.networks.clouds import CloudSegmenter as CloudSegmenter
from jaxnbv.networks.invariant import Focus as Focus
from jaxnbv.networks.invariant import InvariantClassifier as InvariantClassifier
from jaxnbv.networks.pointnet2 import CompactPartSegmenter as CompactPartSegmenter
from jaxnbv.networks.pointnet2 import PointNet2Classifier as PointNet2Classifier
from jaxnbv.networks.pointnet2 import PointNet2PartSegmenter as PointNet2PartSegmenter
from jaxnbv.networks.pretrained import network_scale as network_scale
from jaxnbv.networks.pretrained import part_segmenter as part_segmenter
from jaxnbv.networks.pretrained import pretrained_classifier as pretrained_classifier
