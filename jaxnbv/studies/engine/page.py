"""Chapters of studies as one page: HTML that opens offline, or Markdown beside its images."""

import base64
import html
import itertools
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from PIL import Image

from jaxnbv.checks import require
from jaxnbv.storage.files import make_folder, write_text, write_whole
from jaxnbv.studies.engine.chapters import Chapter, Table, chapters
from jaxnbv.version import __version__

_TITLE = "Results of studies"
_STYLE = """
  :root { --ink: #1f2733; --soft: #566071; --line: #d9dee6; --accent: #b34a00; --page: #f6f7f9; }
  * { box-sizing: border-box; }
  body { margin: 0; background: var(--page); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
  main { max-width: 1100px; margin: 0 auto; padding: 20px 16px 40px; }
  h1 { font-size: 24px; }
  h2 { font-size: 20px; margin: 40px 0 8px; border-top: 1px solid var(--line); padding-top: 20px; }
  nav a { margin-right: 18px; color: var(--accent); white-space: nowrap; }
  .scroll { overflow-x: auto; background: #fff; border: 1px solid var(--line); border-radius: 8px; margin: 12px 0; }
  table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; min-width: 100%; }
  caption { text-align: left; padding: 8px 12px 2px; font-weight: 600; }
  th, td { padding: 3px 12px; text-align: right; white-space: nowrap; } th:first-child { text-align: left; }
  thead th { color: var(--soft); font-weight: 500; border-bottom: 1px solid var(--line); }
  tbody th { font-weight: 500; } .best { font-weight: 700; } .second { text-decoration: underline; }
  img { max-width: 100%; height: auto; background: #fff; border: 1px solid var(--line); border-radius: 8px; }
  figure { margin: 14px 0; } figcaption, .facts, pre { font-size: 13px; color: var(--soft); }
  pre { overflow-x: auto; } details { font-size: 13px; margin: 8px 0; } summary { cursor: pointer; }
  .claims td, .claims th { white-space: normal; text-align: left; }
"""


def write_page(folder: str | Path, out: str | Path) -> Path:
    """Write a page of all studies in a folder, and return its path.

    - `out`: a file that ends in .html, which holds its images, or in .md, whose images go to a folder beside it, of
      its name.

    **Raises:** `ValueError` for another ending, and as `chapters` does.
    """
    out = Path(out)
    require(out.suffix in (".html", ".md"), f"the page {out} must end in .html or .md")
    found = chapters(folder)
    make_folder(out.parent)
    write_text(out, as_html(found) if out.suffix == ".html" else _markdown_with_images(found, out))
    return out


def as_html(found: Sequence[Chapter]) -> str:
    """One file that opens offline."""
    links = " ".join(f'<a href="#study{i}">{html.escape(c.title)}</a>' for i, c in enumerate(found))
    body = "".join(_html_chapter(index, chapter) for index, chapter in enumerate(found))
    overview = _overview(found)
    claims = _html_table(overview, "claims") if overview.rows else ""
    return (
        f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8"><title>{_TITLE}</title>\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n<style>{_STYLE}</style></head>\n'
        f'<body><main><h1>{_TITLE}</h1>\n<p class="facts">jaxnbv {__version__}, {datetime.now(UTC):%Y-%m-%d}. '
        f"Bold: the best. Underlined: the second, or an interval that excludes zero.</p>\n<nav>{links}</nav>\n"
        f"{claims}{body}</main></body></html>\n"
    )


def _html_chapter(index: int, chapter: Chapter) -> str:
    facts = "<br>".join(map(html.escape, chapter.facts))
    explanation = html.escape(chapter.explanation).replace("\n", " ")
    claims = "".join(
        f"<p><strong>{html.escape(v.claim.text)}</strong> {html.escape(v.sentence)}</p>\n" for v in chapter.claims
    )
    images = "".join(
        f'<figure><img alt="{html.escape(caption)}" src="data:image/png;base64,'
        f'{base64.b64encode(file.read_bytes()).decode()}"><figcaption>{html.escape(caption)}</figcaption></figure>\n'
        for caption, file in chapter.images
    )
    return (
        f'<section id="study{index}"><h2>{html.escape(chapter.title)}</h2>\n{claims}<p>{explanation}</p>\n'
        f'<p class="facts">{facts}</p>\n{images}{_folded(chapter.tables, _html_table)}'
        f"<details><summary>Settings</summary><pre>{html.escape(chapter.settings)}</pre></details></section>\n"
    )


def _overview(found: Sequence[Chapter]) -> Table:
    """All claims of the paper, and whether they hold."""
    rows = [
        [chapter.title, str(chapter.scenes), verdict.claim.text, f"{verdict.held} of {len(verdict.against)}"]
        for chapter in found
        for verdict in chapter.claims
    ]
    return Table(
        "What the paper says, and whether it holds here", ["study", "scenes", "claim", "holds against methods"], rows
    )


def _folded(tables: Sequence[Table], write: Callable[[Table], str]) -> str:
    """Those of all scenes, and those of each group of scenes to be opened."""
    parts = []
    for group, members in itertools.groupby(tables, key=lambda table: table.group):
        text = "\n\n".join(map(write, members))
        parts.append(f"<details><summary>{html.escape(group)}</summary>\n\n{text}\n\n</details>" if group else text)
    return "\n\n".join(parts)


def _html_table(table: Table, kind: str = "") -> str:
    head = "".join(f'<th scope="col">{html.escape(name)}</th>' for name in table.header)
    rows = "".join(
        f'<tr><th scope="row">{html.escape(name)}</th>{"".join(map(_html_cell, cells))}</tr>'
        for name, *cells in table.rows
    )
    caption = f"<caption>{html.escape(table.caption)}</caption>"
    body = f"{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f'<div class="scroll"><table class="{kind}">{body}</table></div>\n'


def _html_cell(cell: str) -> str:
    mark = "best" if cell.endswith("**") else "second" if cell.endswith("*") else ""
    return f'<td class="{mark}">{html.escape(cell.rstrip("* "))}</td>' if mark else f"<td>{html.escape(cell)}</td>"


def _markdown_with_images(found: Sequence[Chapter], out: Path) -> str:
    """The text; its images are copied beside it, and those of a page that was there before are removed."""
    images, overview = out.with_suffix(""), _overview(found)
    before = set(images.glob("[0-9]*-*.png"))
    marks = "Bold: the best. Italic: the second, or an interval that excludes zero."
    sections = [f"# {_TITLE}", f"Written by `jaxnbv report`, jaxnbv {__version__}. {marks}"]
    sections += [_markdown_table(overview, "---")] if overview.rows else []
    for index, chapter in enumerate(found):
        sections += [f"## {chapter.title}", *(f"**{v.claim.text}** {v.sentence}" for v in chapter.claims)]
        sections += [chapter.explanation.replace("\n", " "), "\n".join(chapter.facts)]
        for caption, file in chapter.images:
            copy = make_folder(images) / f"{index}-{file.name}"
            # A third of the size, for a repository.
            image = Image.open(file).convert("RGB").quantize(256)
            write_whole(copy, partial(image.save, format="png", optimize=True))
            before.discard(copy)
            sections.append(f"![{caption}]({images.name}/{copy.name})")
        sections.append(_folded(chapter.tables, _markdown_table))
        sections.append(f"<details><summary>Settings</summary>\n\n```json\n{chapter.settings}\n```\n\n</details>")
    for file in before:
        file.unlink()
    return "\n\n".join(sections) + "\n"


def _markdown_table(table: Table, rule: str = "---:") -> str:
    rows = [table.header, ["---", *(rule for _ in table.header[1:])]]
    rows += [[name, *map(_markdown_cell, cells)] for name, *cells in table.rows]
    lines = "\n".join(f"| {' | '.join(row)} |" for row in rows)
    return f"**{table.caption}**\n\n{lines}"


def _markdown_cell(cell: str) -> str:
    text = cell.rstrip("* ").replace("|", "\\|")
    return f"**{text}**" if cell.endswith("**") else f"*{text}*" if cell.endswith("*") else text
