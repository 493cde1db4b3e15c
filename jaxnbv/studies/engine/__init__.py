"""Engine of studies: base class, and functions that run scenes and make tables, charts and pages."""
