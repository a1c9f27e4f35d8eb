"""The network viewer: a page of viser, whose pictures are made by our own rasterizer.

What is shown is what is trained: between two steps of a training the pictures that browsers wait
for are rendered from the very Gaussians that the next step changes. `viewer.NetworkViewer` is what
the command line uses.

    look.py      what a browser wants to see
    pictures.py  Gaussians + camera + look → picture; pure
    session.py   who looks from where, what runs, what is due; pure, any thread
    gauge.py     curves of loss and PSNR
    server.py    viser on a free port of this machine
    page.py      the controls of the page ↔ session
    photos.py    the cameras of the photos, in the scene and to stand at
    viewer.py    all of it, between the steps of a training and after it
"""
