"""`blocks`: a scene that is larger than the memory, trained in blocks and merged.

`cells` cuts the ground plane, `plan` chooses the photos and points of each block, `block_dataset`
writes them as an ordinary dataset, `train` trains the blocks, and `merge` joins their scenes.
"""
