"""PointNet++ classifiers and the loading of published checkpoints."""

from jaxnbv.networks.checkpoints import convert_checkpoint as convert_checkpoint
from jaxnbv.networks.checkpoints import load_checkpoint as load_checkpoint
from jaxnbv.networks.checkpoints import load_safetensors as load_safetensors
from jaxnbv.networks.checkpoints import load_torch_checkpoint as load_torch_checkpoint
from jaxnbv.networks.checkpoints import save_safetensors as save_safetensors
from jaxnbv.networks.grouping import ball_query as ball_query
from jaxnbv.networks.grouping import farthest_point_indices as farthest_point_indices
from jaxnbv.networks.pointnet2 import PointNet2Classifier as PointNet2Classifier
from jaxnbv.networks.torch_format import read_torch_tensors as read_torch_tensors
