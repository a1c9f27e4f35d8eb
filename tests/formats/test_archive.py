"""Zip files around scenes, projects of SuperSplat, checkpoints of gsplat, folders of SOG."""

import json
import math
import zipfile

import pytest
import torch

from snowsplat.formats import format_for_reading, gsplat_checkpoint, read_gaussians, write_gaussians
from snowsplat.pipeline.describe import describe
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.project.project import Project
from snowsplat.scene import edit
from snowsplat.scene.geometry import Similarity, rotation_from_quat
from snowsplat.util.errors import UserError


@pytest.fixture
def ply(tmp_path, make_scene):
    """The scene, and its PLY as bytes."""
    scene = make_scene(40, 1)
    write_gaussians(tmp_path / "scene.ply", scene)
    return scene, (tmp_path / "scene.ply").read_bytes()


def packed(path, members: dict[str, bytes | str], method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as bundle:
        for name, content in members.items():
            bundle.writestr(name, content)
    return path


def assert_same(a, b, atol=0.0):
    for name, tensor in a.parameters().items():
        torch.testing.assert_close(b.parameters()[name], tensor, rtol=0, atol=atol)


@pytest.mark.parametrize("method", [zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED])
def test_the_only_scene_of_a_zip_file(tmp_path, ply, method):
    scene, data = ply
    cloud = b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    members = {"__MACOSX/._a.ply": b"x", "readme.txt": b"hi", "points.ply": cloud, "d/a.ply": data}
    path = packed(tmp_path / "luma.zip", members, method)
    assert_same(scene, read_gaussians(path))
    assert describe(path)["format"] == "zip file"


def test_other_zip_files_are_named(tmp_path, ply, one_line):
    _, data = ply
    two = packed(tmp_path / "a.zip", {"a.ply": data, "b.ply": data})
    assert "contains 2 scenes; unzip it, and use 'a.ply', 'b.ply'" in one_line(two)
    other = packed(tmp_path / "b.zip", {"x/scan.spz": b"."})
    assert "unzip it, and use 'x/scan.spz'" in one_line(other)
    usd = packed(tmp_path / "c.zip", {"a.txt": b"", "scene.usdc": b"."}, zipfile.ZIP_STORED)
    assert "unzip it, and use 'scene.usdc'" in one_line(usd)
    assert "contains 'x'" in one_line(packed(tmp_path / "d.zip", {"x": b""}))
    bomb = packed(tmp_path / "e.zip", {"a.ply": data + bytes(40 << 20)})
    assert "would unpack" in one_line(bomb)


def test_a_sog_scene_whose_description_is_not_first(tmp_path, make_scene):
    write_gaussians(tmp_path / "a.sog", make_scene(20, 0))
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        members = {name: bundle.read(name) for name in reversed(bundle.namelist())}
    again = packed(tmp_path / "b.sog", {"readme.txt": b"", **members})
    assert_same(read_gaussians(tmp_path / "a.sog"), read_gaussians(again))


def test_a_project_places_its_visible_splats(tmp_path, ply, caplog):
    scene, data = ply
    default = {"position": [0, 0, 0], "rotation": [0, 0, 1, 0], "scale": [1, 1, 1], "visible": True}
    angle = 0.4
    # In the frame of the project, which is turned by 180° about z: first that turn, then another
    # about y, then scale and offset.
    turn = [math.sin(angle / 2), 0.0, math.cos(angle / 2), 0.0]
    moved = {"position": [1, 2, 3], "rotation": turn, "scale": [2, 2, 2]}
    settings = [default, {**default, "visible": False}, moved | {"tintClr": [1, 0.5, 1, 1]}]
    members = {"document.json": json.dumps({"splats": settings})}
    members |= {f"splat_{i}.ply": data for i in range(3)}
    read = read_gaussians(packed(tmp_path / "a.ssproj", members))
    assert len(read) == 80
    assert_same(scene, read.select(torch.arange(40)))
    x, y, z, w = turn
    in_project = rotation_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64))
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0], dtype=torch.float64))
    place = Similarity(2.0, half @ in_project, half @ torch.tensor([1.0, 2, 3]).double())
    assert_same(edit.transform(scene, place), read.select(torch.arange(40, 80)), 1e-5)
    assert "1 hidden splats" in caplog.text
    assert "colour settings" in caplog.text
    bare = packed(tmp_path / "b.ssproj", {"document.json": "{}", "splat_0.ply": data})
    assert_same(scene, read_gaussians(bare))


@pytest.mark.parametrize(
    "change",
    [{"scale": [1, 2, 1]}, {"scale": []}, {"scale": [-1] * 3}, {"rotation": [0] * 4},
     {"rotation": "x"}, {"position": [1e999, 0, 0]}, {"position": None}, {"scale": [1e308]}],
)  # fmt: skip
def test_invalid_places_are_reported(tmp_path, ply, one_line, change):
    own = {"position": [0, 0, 0], "rotation": [0, 0, 1, 0], "scale": [1, 1, 1], **change}
    document = json.dumps({"splats": [own]})
    members = {"document.json": document, "splat_0.ply": ply[1]}
    assert "document.json" in one_line(packed(tmp_path / "a.ssproj", members))


def splats_of(scene) -> dict[str, torch.Tensor]:
    own = {"means": scene.means, "scales": scene.log_scales, "quats": scene.quats}
    own |= {"opacities": scene.opacity_logits, "sh0": scene.sh_dc, "shN": scene.sh_rest}
    return own


def saved(path, content):
    torch.save(content, path)
    return path


def test_a_checkpoint_of_gsplat(tmp_path, make_scene, caplog):
    scene = make_scene(30, 2)
    own = torch.nn.ParameterDict(splats_of(scene)).state_dict()
    path = saved(tmp_path / "ckpt_29_rank0.pt", {"step": 29, "splats": own})
    assert_same(scene, read_gaussians(path))
    assert format_for_reading(path).name == "gsplat checkpoint"
    assert caplog.text == ""
    own["shN"] = torch.cat([scene.sh_rest, torch.ones(30, 16, 3)], 1)
    own["means"] = own["means"].double() + torch.tensor([0.0, 5.4e6, 0.0])
    read = read_gaussians(saved(tmp_path / "ckpt_29_rank1.pt", {"splats": own}))
    assert read.sh_degree == 3
    assert "reduced to 3" in caplog.text
    assert "ckpt_29_rank0.pt has more Gaussians" in caplog.text
    assert read.origin[1] == pytest.approx(5.4e6, abs=5)
    world = read.means.double() + torch.tensor(read.origin, dtype=torch.float64)
    torch.testing.assert_close(world, own["means"], rtol=0, atol=1e-6)


class Code:
    def __reduce__(self):
        return print, ("code of the file runs",)


def test_other_checkpoints_are_named(tmp_path, make_scene, one_line, capfd, monkeypatch):
    huge = {"splats": {**splats_of(make_scene(5, 0)), "means": torch.zeros(1).expand(1 << 40, 3)}}
    assert "damaged or too large" in one_line(saved(tmp_path / "a.pt", huge))  # by the child
    monkeypatch.setattr(gsplat_checkpoint, "check_readable", lambda *_: None)
    own = splats_of(make_scene(5, 0))
    cases = {
        "app_opt": {"splats": {**{k: own[k] for k in list(own)[:4]}, "features": own["means"]}},
        "reference implementation": (tuple(own.values()), 30_000),
        "nerfstudio": {"pipeline": {"_model.means": own["means"]}},
        "no scales, quats, opacities, sh0": {"step": 1, "splats": {"means": own["means"]}},
        "shapes": {"splats": {**own, "scales": own["quats"]}},
        "not tensors of numbers": {"splats": {**own, "means": [1, 2, 3]}},
        "cannot be loaded safely": {"splats": Code()},
    }
    for expected, content in cases.items():
        assert expected in one_line(saved(tmp_path / "a.pt", content))
    assert "code of the file" not in capfd.readouterr().out


def test_a_folder_of_sog_is_a_scene(tmp_path, make_scene):
    write_gaussians(tmp_path / "a.sog", make_scene(20, 1))
    folder = tmp_path / "folder"
    with zipfile.ZipFile(tmp_path / "a.sog") as bundle:
        bundle.extractall(folder)
    assert Project.open(folder).scene_file() == folder / "meta.json"
    assert_same(read_gaussians(tmp_path / "a.sog"), load_viewable(folder).gaussians)
    assert describe(folder)["gaussians"] == 20
    (folder / "meta.json").write_text('{"what": "the data of another program"}')
    with pytest.raises(UserError, match="no scene"):
        Project.open(folder).scene_file()
