"""One file a task: its utility or its score."""

from jaxnbv.tasks.coverage import Coverage as Coverage
