"""Optimises Gaussians so that their renderings reproduce the photos of a dataset.

core/       the loop (Algorithm 1 of the paper), the settings, the loss, Adam, checkpoints
parts/      what takes part in a training besides the loop, one option per file
starts/     where the first Gaussians come from
density/    density control: adds and removes Gaussians
budgets/    the number of steps and Gaussians for a limit of time or memory
processes/  the Gaussians of a training, distributed over processes
report/     the HTML page about a training
"""
