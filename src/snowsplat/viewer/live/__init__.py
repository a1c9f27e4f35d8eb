"""The live viewer: a page of viser whose images are rendered by our own rasterizer.

It shows Gaussians during training. Between two training steps, the images that browsers have
requested are rendered from the tensors that the next step will change. The command line uses
`viewer.NetworkViewer`.

    display.py      display settings and pose of a browser
    pictures.py     Gaussians + camera + display settings → image; no side effects
    session.py      state of the browsers and of the training, next image to render; thread-safe
    curves.py       curves of loss and PSNR
    server.py       viser on a free port of this machine
    guard.py        limits what connections may do
    page.py         the controls of the page
    photos.py       the cameras of the photos: frustums in the scene, and views at their positions
    key_cameras.py  camera positions stored by a browser, for a video
    viewer.py       combines all of these
    training.py     the viewer between the steps of a training run
"""
