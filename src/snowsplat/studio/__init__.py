"""The studio: a page in the browser that makes scenes from photos, shows them and hands them on.

`app.py` answers requests, `library.py` and `uploads.py` keep files, `job.py` starts processes of
`worker.py`, which does all that takes long or needs torch. So the server starts at once, and a job
does not end with it.
"""
