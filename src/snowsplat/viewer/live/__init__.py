"""The live viewer: a page built with viser, whose images the rasterizer of snowsplat renders.

It shows Gaussians during training. Between two training steps, the images that browsers have
requested are rendered, without a copy of the Gaussians. `viewer.NetworkViewer` is the page.

    display.py      display settings and camera pose of a browser
    pictures.py     renders an image, from Gaussians, a camera and display settings
    session.py      state of the browsers and of the training, next image to render; thread-safe
    curves.py       curves of loss and PSNR
    server.py       starts viser's server on a free port
    guard.py        checks connections and messages, and limits their cost
    controls.py     the controls of the page
    photos.py       the cameras of the photos: frustums in the scene, and views from their poses
    key_cameras.py  views that a user stores, for a video along them
    shortcuts.py    keys and theme
    palette.py      colour maps
    viewer.py       combines these modules
    training.py     updates the viewer between the steps of a training run
"""
