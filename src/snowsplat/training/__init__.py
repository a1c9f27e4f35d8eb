"""Optimises Gaussians so that their renderings reproduce the photos of a dataset.

The parts of the paper are in these modules: Algorithm 1 in `trainer`, initialisation in `init`, the
loss in `losses`, learning rates in `lr_schedule`, Adam in `optim`, densification in `density`.
`config` defines all settings; `recipes` contains complete configurations.
"""
