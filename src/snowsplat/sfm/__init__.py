"""Makes the folder of a dataset, as `snowsplat.data` reads it, from photos or a video.

    stage     what it does                                code                files
    photos    copies photos, video frames and masks       ingest/             input/
    poses     estimates the camera poses                  colmap/             distorted/
    images    removes the distortion, orients the scene   orient/, undistort  images/, sparse/0/
    report    writes dataset_report.html                  report/

Each stage reads the files of the earlier stages and writes its own. `make_dataset.make_dataset`
runs the stages in this order and skips those that are already finished.
"""
