"""The live viewer: a page whose images the rasterizer of snowsplat renders.

It shows Gaussians during training. Between two training steps, the images that browsers have
requested are rendered, without a copy of the Gaussians. `viewer.NetworkViewer` is the page; `page/`
is what runs in the browser.
"""
