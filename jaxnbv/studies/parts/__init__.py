"""Studies of the discovery of semantic parts, the paper's Table 1."""
