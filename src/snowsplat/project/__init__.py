"""The files of a project on disk: their names, and reading and writing them.

`Project.open` reads a folder, or a file in it: which photos, dataset, training, scene file, edits
and title belong together. Only this package knows the names of these files. It imports no torch:
what reads Gaussians or a dataset takes the paths that a `Project` hands out.
"""
