"""What the documents name is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = sorted(path.relative_to(ROOT) for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")))


@pytest.mark.parametrize("document", DOCUMENTS, ids=str)
def test_links_and_paths_lead_somewhere(document):
    text = (ROOT / document).read_text()
    links = re.findall(r"\]\(([^)#]+)[^)]*\)", text)
    named = re.findall(r"`((?:jaxnbv|tests|docs|scripts|benchmarks|examples|notebooks|\.ci)/[\w./-]*)`", text)
    beside = [(ROOT / document).parent / link for link in links if "://" not in link]
    missing = [str(path) for path in (*beside, *(ROOT / name for name in named)) if not path.exists()]
    assert not missing


def test_documents_are_read():
    assert {"README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/cluster.md"} <= set(map(str, DOCUMENTS))
