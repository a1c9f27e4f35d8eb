"""What the subcommands do, as functions for Python.

    make.py      photos or a video -> scene
    train.py     dataset -> scene; resume after an interruption
    render.py    scene -> images; videos.py: scene -> video
    evaluate.py  scene -> PSNR, SSIM, LPIPS
    convert.py   scene file -> another format, edited
    describe.py  file or folder -> what it contains
    watch.py     the output folder of a training, in the browser

Each function takes paths and options and returns a result or raises a
`snowsplat.util.errors.UserError`. None of them prints: progress goes to an `Observer`.
"""
