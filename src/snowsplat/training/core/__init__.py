"""The loop of a training (Algorithm 1 of the paper), and what every training needs."""
