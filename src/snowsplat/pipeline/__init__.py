"""What the subcommands do, as functions for Python.

    make.py      photos or a video -> a scene
    train.py     a dataset -> a scene; resuming after an interruption
    render.py    a scene -> images
    videos.py    a scene -> a video
    evaluate.py  a scene -> PSNR, SSIM, LPIPS
    convert.py   scene files -> an edited scene in another format
    describe.py  a file or folder -> a description of its contents
    watch.py     shows the output folder of a training run in the browser

Each function takes paths and options and returns a result or raises a
`snowsplat.util.errors.UserError`. None of them prints: progress goes to an `Observer`.
"""
