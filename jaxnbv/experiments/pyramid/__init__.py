"""The classification of pyramids whose class shows on the base alone: the paper's synthetic data set."""
