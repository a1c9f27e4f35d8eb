"""`snowsplat clean`: what it prints, and its errors."""


def test_clean_a_training(run, dataset, tmp_path):
    out, target = tmp_path / "out", tmp_path / "clean.spz"
    assert run("train", dataset, "-o", out, "--iterations", "30", "--eval").code == 0
    result = run("clean", out, target)
    assert result.code == 0, result.err
    assert "Gaussians removed; PSNR of 2 held-out photos" in result.out
    assert target.stat().st_size > 0
    again = run("clean", out, target)
    assert again.code == 2
    assert "--overwrite" in again.err


def test_errors_are_one_line(run, tmp_path):
    for arguments, message in (
        ((), "a scene and the name of a file"),
        ((tmp_path / "none.ply", tmp_path / "b.ply"), "no such file"),
        ((tmp_path / "none.ply", tmp_path / "b.xyz"), "b.xyz"),
    ):
        result = run("clean", *arguments)
        assert result.code == 2
        assert message in result.err
        assert result.err.count("\n") == 1
