"""The files of a published site, which may be a stranger's."""

from snowsplat.viewer.web.publication import site_files


def test_links_that_leave_a_site_are_not_followed(tmp_path):
    site, secret = tmp_path / "site", tmp_path / "secret.txt"
    site.mkdir()
    secret.write_text("secret")
    for name in ("index.html", "scene.sog"):
        (site / name).write_text(name)
    (site / "out.txt").symlink_to(secret)
    (site / "folder").symlink_to(tmp_path)
    (site / "in.txt").symlink_to(site / "scene.sog")
    files, _ = site_files(site)
    assert set(files) == {"", "index.html", "scene.sog", "in.txt"}
