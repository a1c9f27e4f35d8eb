"""A scene in a snow globe, which can be shaken: a web page and a video.

    dimensions.py  the shape of the globe
    layout.py      selects the subject of a scene and moves it into the globe
    physics.py     the motion of the Gaussians
    flakes.py      how a Gaussian looks while it is snow
    glass.py       background, glass and base, by ray tracing
    plate.py       the name of the scene, for the plate on the base
    globe_video.py  the video
    globe_page.py   the web page, from the files in web/

A flake is a Gaussian that has come loose.
"""
