"""A scene that was edited in a page is the same in an independent program."""

import numpy as np

from snowsplat.formats import read_arrays
from snowsplat.formats.sog import read_sog
from snowsplat.pipeline.edit import edit
from snowsplat.pipeline.publish import publish
from snowsplat.project.edit_record import PageEdit
from snowsplat.project.site_folder import SiteFolder

from ..pipeline.test_edit import N, bits, write_scene


def test_splat_transform_reads_what_the_page_shows(tmp_path, splat_transform):
    scene = write_scene(tmp_path, with_cameras=False)
    shown = read_sog(SiteFolder(tmp_path / "site").scene())
    distances = np.linalg.norm(shown.means, axis=1)
    gone = distances > np.median(distances)  # no limit of a slider
    edited = edit(scene, tmp_path / "site", PageEdit(N, bits(gone), scale=0.25))
    splat_transform(edited, tmp_path / "back.ply")
    theirs, ours = read_arrays(tmp_path / "back.ply"), read_arrays(edited)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh_dc", "sh_rest"):
        assert np.allclose(getattr(theirs, name), getattr(ours, name), atol=1e-5), name
    publish(edited, tmp_path / "site", overwrite=True)
    page = read_sog(SiteFolder(tmp_path / "site").scene())
    assert len(page.means) == len(theirs.means) == (~gone).sum()
    # The page may scale a scene; its order is another one.
    in_page, in_theirs = (np.sort(np.linalg.norm(a.means, axis=1)) for a in (page, theirs))
    ratio = in_page / in_theirs
    assert np.allclose(ratio, np.median(ratio), rtol=1e-3)
    assert np.allclose(np.sort(page.opacity_logits), np.sort(theirs.opacity_logits), atol=0.1)
