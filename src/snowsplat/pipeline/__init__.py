"""Python functions that do the work of the subcommands.

    make.py      makes a scene from photos or a video
    demo.py      makes a scene from photos of a synthetic scene
    train.py     trains a scene from a dataset; resumes after an interruption
    render.py    renders images of a scene
    videos.py    renders a video of a scene
    evaluate.py  measures PSNR, SSIM and LPIPS of a scene
    image.py     approximates a photo by 2D Gaussians
    globe.py     puts a scene into a snow globe
    convert.py   merges, edits and converts scene files
    blocks/      trains a scene that is larger than the memory, in blocks
    describe.py  describes the contents of a file or folder
    watch.py     shows the output folder of a training run in the browser

Each function takes paths and options and returns a result or raises a
`snowsplat.util.errors.UserError`. None of them prints: progress goes to an `Observer`.
"""
