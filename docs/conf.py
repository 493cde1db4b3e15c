"""The site: `pip install ".[docs]" && sphinx-build -W -b html docs site`. It is built and read without a network."""

import re
import shutil
import tarfile
import tempfile
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

import jaxnbv
from jaxnbv.studies.engine.page import write_page

ROOT = Path(__file__).resolve().parents[1]

project = "jaxnbv"
release = jaxnbv.__version__
extensions = ["myst_nb", "sphinx.ext.autodoc"]

myst_enable_extensions = ["colon_fence", "dollarmath"]
myst_heading_anchors = 3
nb_execution_mode = "off"

autodoc_member_order = "bysource"
autodoc_default_options = {"members": True, "special-members": "__call__", "show-inheritance": True}
autodoc_preserve_defaults = True
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
toc_object_entries_show_parents = "hide"
add_module_names = False

html_theme = "furo"
html_title = "jaxnbv"
html_show_copyright = False
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_extra_path = ["_extra"]
html_css_files = ["site.css"]
html_js_files = ["copy.js"]


def _copy_notebooks() -> None:
    """The notebooks are pages of the site; Sphinx reads what lies in its own folder."""
    folder = Path(__file__).with_name("notebooks")
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "notebooks", folder, ignore=lambda _, names: [n for n in names if not n.endswith(".ipynb")])


def _write_results() -> None:
    """One page of all studies, from the records that are kept."""
    with tempfile.TemporaryDirectory() as folder:
        for records in sorted((ROOT / "benchmarks" / "records").glob("*.tar.xz")):
            with tarfile.open(records) as archive:
                archive.extractall(folder, filter="data")
        write_page(folder, Path(__file__).with_name("_extra") / "results.html")


def _restructured(app: Sphinx, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Docstrings are Markdown. What reStructuredText writes otherwise: code, lists, and signs that it would take for
    markup."""
    parts = re.split(r"(`[^`]+`)", "\n".join(lines))
    prose = [re.sub(r"(?<!\*)\*(?!\*)|\||_(?=\W|$)", r"\\\g<0>", part) for part in parts[::2]]
    code = [rf"\ `{part}`\ " for part in parts[1::2]]
    text = "".join(a + b for a, b in zip(prose, [*code, ""], strict=True))
    lines[:] = re.sub(r"(?m)^(?! *- )(.*\S.*)\n(?=- )", r"\1\n\n", text).split("\n")


def _short(app: Sphinx, what: str, name: str, obj: Any, options: Any, given: str | None, returned: str | None) -> Any:
    """Arrays and keys by the names that the code has for them."""

    def renamed(text: str | None) -> str | None:
        text = text and text.replace("jaxlib._jax.Array", "Array").replace("~jaxtyping.", "").replace("jaxtyping.", "")
        return text and text.replace("Key[Array, ''] | UInt32[Array, '2'] | UInt32[Array, '4']", "PRNGKeyArray")

    return renamed(given), renamed(returned)


def _visit_math(self: Any, node: nodes.math) -> None:
    """MathML, which browsers draw by themselves."""
    self.body.append(tex2mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _visit_display(self: Any, node: nodes.math_block) -> None:
    self.body.append(f'<div class="math">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """What Sphinx calls."""
    _copy_notebooks()
    _write_results()
    app.add_html_math_renderer("mathml", inline_renderers=(_visit_math, None), block_renderers=(_visit_display, None))
    app.connect("autodoc-process-docstring", _restructured)
    app.connect("autodoc-process-signature", _short)
