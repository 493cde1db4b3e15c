"""Results on disk: folders of JSON, NumPy and PLY files. Each file is written completely or not at all."""

from jaxnbv.storage.description import describe as describe
from jaxnbv.storage.rebuilding import rebuild as rebuild
from jaxnbv.storage.run_folder import RunFolder as RunFolder
