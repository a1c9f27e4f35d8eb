"""The inputs of structure from motion: finds photos and videos, and checks and copies them.

    search/      finds the files
    inputs       fills ``input/`` of a dataset
    photos/      reads photos, their metadata and masks, and copies them
    video/       reads a video, and chooses and writes its frames
    content/     what photos show: bars, discs, panoramas, nothing

`inputs.gather` fills ``input/``, and returns the photos that the next stages use.
"""
