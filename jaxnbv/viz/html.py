"""Makes HTML pages from Jinja templates. Values are escaped unless the template says `safe`."""

import base64
from pathlib import Path
from typing import Any

import jinja2


def render(template: Path, **values: Any) -> str:
    """Return the text of a Jinja template file, filled with these values."""
    settings: dict[str, Any] = {"autoescape": True, "trim_blocks": True, "lstrip_blocks": True}
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, **settings)
    environment.filters["base64"] = lambda content: base64.b64encode(content).decode()
    return environment.from_string(template.read_text(encoding="utf-8")).render(values)
