"""Studies that count the views until all semantic parts of an object are found, as in the paper's Table 1."""
