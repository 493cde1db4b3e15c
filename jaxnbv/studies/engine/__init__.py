"""Base class of studies, the runs of their scenes, and tables, charts and pages of the results."""
