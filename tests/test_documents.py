"""What the documents name is there."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted(path.relative_to(ROOT) for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")))


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_links_and_paths_lead_somewhere(document):
    text = (ROOT / document).read_text()
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    named = re.findall(r"`((?:jaxnbv|tests|docs|scripts|benchmarks|examples|notebooks|\.ci)/[\w./-]*)`", text)
    # Sphinx copies the notebooks into the site.
    beside = [(ROOT / document).parent / link for link in links if "://" not in link]
    beside = [ROOT / "notebooks" / path.name if path.parent.name == "notebooks" else path for path in beside]
    missing = [str(path) for path in (*beside, *(ROOT / name for name in named)) if not path.exists()]
    assert not missing


def test_documents_are_read():
    assert {"README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/how_to/cluster.md"} <= set(map(str, DOCUMENTS))


def test_a_package_page_has_links_to_the_web_alone():
    """Of the README, as the package's build rewrites it."""
    text = (ROOT / "README.md").read_text()
    links = re.compile(r"!?\[[^\]]*\]\(([^)]*)\)")
    assert "docs/demo.gif" in links.findall(text)
    hook = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["metadata"]["hooks"]
    for change in hook["fancy-pypi-readme"]["substitutions"]:
        text = re.sub(change["pattern"], change["replacement"], text)
    left = links.findall(text)
    assert left
    assert all(link.startswith("https://") for link in left)
    assert "concepts, each formula" in text
