"""Results on disk: folders of plain JSON, NumPy and PLY files, written one by one and never half a file."""

from jaxnbv.storage.description import describe as describe
from jaxnbv.storage.episode_folder import EpisodeFolder as EpisodeFolder
from jaxnbv.storage.session_folder import DepthImage as DepthImage
from jaxnbv.storage.session_folder import SessionFolder as SessionFolder
