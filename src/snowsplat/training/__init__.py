"""Optimises Gaussians so that their renderings reproduce the photos of a dataset.

Each folder imports only those below it:

report/     the HTML page about a training
budgets/    the number of steps and Gaussians for a limit of time or memory
core/       the loop (Algorithm 1 of the paper), checkpoints
parts/      what takes part in a training besides the loop, one option per file
density/    density control: adds and removes Gaussians
starts/     where the first Gaussians come from
step/       what one step is made of: views, their gradients, the loss, Adam
processes/  the Gaussians of a training, distributed over processes
settings/   each setting, the recipes, the schedule
"""
