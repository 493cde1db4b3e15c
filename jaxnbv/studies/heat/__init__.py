"""The search for the coldest point of a heated body: the paper's heat diffusion."""
