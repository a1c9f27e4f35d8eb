"""Optimises Gaussians so that their renderings reproduce the photos of a dataset.

Where the parts of the paper are: Algorithm 1 in `trainer`, initialisation in `init`, the loss in
`losses`, learning rates in `lr_schedule`, Adam in `optim`, densification in `density`. `recipes`
has complete configurations, `config` every setting.
"""
