"""Studies that count the views until all semantic parts of an object are found (the paper's Table 1)."""
