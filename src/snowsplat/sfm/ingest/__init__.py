"""The inputs of structure from motion: finds photos and videos, and checks and copies them.

    sources      finds the files
    inputs       fills ``input/`` of a dataset: gather_photos copies photos, video_frames frames
    clip, motion, key_frames   read a video and choose its frames
    photo_files, exif, mask_files   read and write image files
    sharpness    rejects images without content

`inputs.gather` fills ``input/``, and returns the photos that the next stages use.
"""
