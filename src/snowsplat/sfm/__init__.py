"""Photos or a video -> the folder of a posed dataset, as `snowsplat.data` reads it.

    photos    copy photos, video frames and masks         ingest/             -> input/
    poses     estimate the camera poses                   colmap/             -> distorted/
    images    remove lens distortion, orient the scene    orient, undistort   -> images/, sparse/0/
    report    write capture_report.html                   report

Each stage is a plain function from folder to folder. `dataset_folder.make_dataset` runs them in
this order and skips the stages that are already finished.
"""
