"""Results on disk: folders of plain JSON, NumPy and PLY files, written one by one and never half a file."""

from jaxnbv.storage.description import describe as describe
from jaxnbv.storage.rebuilding import rebuild as rebuild
from jaxnbv.storage.run_folder import RunFolder as RunFolder
