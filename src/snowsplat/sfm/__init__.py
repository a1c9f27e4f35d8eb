"""Photos or a video -> the folder of a posed dataset, as `snowsplat.data` reads it.

    gather      photos, frames of a video, masks            inputs, video    -> input/
    sfm         where each was taken from                   sfm/             -> distorted/
    undistort   turned upright, without lens distortion     orient, undistort -> images/, sparse/0/

Each step is a plain function from folder to folder; `make_capture` runs them in order and knows
which are done already.
"""
