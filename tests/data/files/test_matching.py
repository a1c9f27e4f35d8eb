"""The files that names mean: what is certain is found, and what is not certain is not."""

import random
import unicodedata

import pytest

from snowsplat.data.files.matching import match_names


def in_bytes_of(encoding, name):
    """A name as it is read from a file whose bytes are in another encoding."""
    return name.encode(encoding).decode("utf-8", "surrogateescape")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("0001.jpg", "0001.JPG"),
        ("IMG_0001.JPG", "img_0001.jpg"),
        ("0001.jpg", "0001.png"),
        ("cam1/0001.jpg", "0001.jpg"),
        ("0001.jpg", "cam1/0001.jpg"),
        ("cam1\\0001.jpg", "cam1/0001.jpg"),
        ("/home/me/scan/images/0001.jpg", "images/0001.jpg"),
        ("C:\\Users\\me\\scan\\images\\0001.jpg", "images/0001.PNG"),
        ("../photos/0001.jpg", "0001.jpg"),
        ("images/0001.jpg", "rgb/0001.jpg"),
        ("./images/r_0", "images/r_0.png"),
        (unicodedata.normalize("NFD", "größe/1.jpg"), unicodedata.normalize("NFC", "größe/1.jpg")),
        (in_bytes_of("gbk", "花园0001.jpg"), "花园0001.jpg"),
        (in_bytes_of("shift_jis", "庭園ソ1.jpg"), "庭園ソ1.jpg"),
        (in_bytes_of("latin-1", "Gebäude 1.jpg"), "Gebäude 1.jpg"),
        ("花园0001.jpg", in_bytes_of("gbk", "花园0001.jpg")),
        ("Ã¤pfel.jpg", "äpfel.jpg"),
    ],
)
def test_a_name_differs_from_its_file(name, file):
    others = ["other.jpg", "images/2.jpg", "rgb/3.jpg"]
    assert match_names([name], [*others, file]).files == {name: file}


@pytest.mark.parametrize(
    ("names", "files", "doubtful"),
    [
        (["1.jpg"], ["1.png", "1.webp"], ["1.jpg"]),
        (["1.jpg"], ["a/1.jpg", "b/1.jpg"], ["1.jpg"]),
        (["a/1.jpg", "b/1.jpg"], ["1.jpg"], ["a/1.jpg", "b/1.jpg"]),
        # 2.jpg would be certain, if it were not for 1.jpg: it may be that of the other camera.
        (["a/1.jpg", "b/1.jpg", "b/2.jpg"], ["1.jpg", "2.jpg"], ["a/1.jpg", "b/1.jpg"]),
        (["1.JPG"], ["1.Jpg", "1.jpG"], ["1.JPG"]),
        (["cam1/1.jpg"], ["cam2/1.jpg"], []),
        (["1.jpg"], ["11.jpg", "1_mask.jpg", "a1.jpg"], []),
    ],
)
def test_what_is_in_doubt_is_not_found(names, files, doubtful):
    matches = match_names(names, files)
    assert matches.files == {}
    assert matches.doubtful == doubtful


def test_the_longest_common_end_of_the_paths_counts():
    files = ["a/images/1.jpg", "b/images/1.jpg", "1.jpg"]
    assert match_names(["/x/b/images/1.jpg"], files).files == {"/x/b/images/1.jpg": files[1]}


def test_names_that_are_no_names():
    names = ["", "/", "..", "\ud800.jpg", "\0", "a" * 10_000, "/".join("ab" * 500)]
    assert match_names(names, ["1.jpg", "\ud800\udc00.png"]).files == {}


def test_random_names_never_find_the_wrong_file():
    """10,000 names, changed alike in each dataset: each finds its own file, or none."""
    letters, generator = ["a", "B", "ß", "é", "园", "1", "2", " ", "_", "(", "."], random.Random(1)
    total = found = 0
    while total < 10_000:
        files = {
            f"{folder}{''.join(generator.choices(letters, k=generator.randrange(1, 4)))}.{suffix}"
            for folder in generator.sample(["", "a/", "cam1/", "cam2/", "cam1/x/"], 2)
            for suffix in generator.choices(["jpg", "JPG", "png"], k=8)
        }
        change = generator.choice(
            [
                str.upper,
                lambda file: file.rpartition(".")[0] + ".tif",
                lambda file: f"/home/me/{file}",
                lambda file: "D:\\" + file.replace("/", "\\"),
                lambda file: unicodedata.normalize("NFD", file),
                lambda file: in_bytes_of("gb18030", file),
                lambda file: file.rpartition("/")[2],
                lambda file: f"front/{file}",
            ]
        )
        truth: dict[str, set[str]] = {}
        for file in sorted(files):
            truth.setdefault(change(file), set()).add(file)
        present = [file for file in sorted(files) if generator.random() < 0.9]
        matches = match_names(list(truth), present)
        assert len(set(matches.files.values())) == len(matches.files)
        wrong = {name: file for name, file in matches.files.items() if file not in truth[name]}
        # A photo that is missing may have a namesake that differs only in its suffix or folder.
        missing = files - set(present)
        assert all(truth[name] & missing for name in wrong), wrong
        total, found = total + len(truth), found + len(matches.files)
    assert found > 0.5 * total
