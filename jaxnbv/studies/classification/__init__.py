"""Studies of the class of an object: the paper's experiments on classification."""
