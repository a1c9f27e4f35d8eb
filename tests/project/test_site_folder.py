"""A site is old or new at any time."""

import pytest

from snowsplat.project.site_folder import SiteFolder
from snowsplat.util import files


def write(site: SiteFolder, scene: str) -> None:
    def page(name: str) -> str:
        return f'{{"contentUrl": "./{name}/scene.sog"}}'

    site.replace(lambda folder: (folder / "scene.sog").write_text(scene) and None, page)


@pytest.fixture
def site(tmp_path):
    site = SiteFolder(tmp_path / "site")
    site.path.mkdir()
    (site.path / "CNAME").write_text("example.org")
    return site


def names(site):
    return {path.name.partition("-")[0] for path in site.path.iterdir()}


def test_a_site_is_replaced_and_other_files_stay(site):
    assert site.content() is None
    write(site, "old")
    before = site.scene()
    assert before.read_text() == "old"
    write(site, "old")
    assert site.scene() == before
    write(site, "new")
    assert site.scene().read_text() == "new"
    assert not before.exists()
    assert sorted(names(site)) == ["CNAME", "files", "index.html"]


def test_a_kill_before_the_page_leaves_the_old_site(site, monkeypatch):
    write(site, "old")
    with monkeypatch.context() as patch:
        patch.setattr(files.os, "fsync", interrupt)  # in the writing of the page
        with pytest.raises(KeyboardInterrupt):
            write(site, "new")
    assert site.scene().read_text() == "old"
    # What it has left is removed, also a folder of which only a part is there.
    for each in site.path.glob("files-*"):
        if each != site.scene().parent:
            (each / "scene.sog").unlink()
    write(site, "new")
    assert site.scene().read_text() == "new"
    assert len(list(site.path.glob("files-*"))) == 1


def interrupt(_: int) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    "page",
    [
        '"contentUrl": "./../files-0123456789ab/scene.sog"',
        '"contentUrl": "./files-0123456789ab/../../secret.sog"',
        '"contentUrl": "./files-0123456789ab/scene.sog"',  # which is missing
        "",
    ],
)
def test_a_page_that_names_other_files_is_no_site(site, page):
    (site.path.parent / "files-0123456789ab").mkdir()
    (site.path.parent / "files-0123456789ab/scene.sog").touch()
    (site.path.parent / "secret.sog").touch()
    site.page.write_text(page)
    assert site.content() is None
    site.page.write_bytes(b"\xff")
    assert site.content() is None
