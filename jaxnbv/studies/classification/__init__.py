"""Studies that classify objects, as in the paper's experiments on classification."""
