"""Exports of other programs: what is read must project points as the other program does."""

import json
import logging
import shutil

import numpy as np
import pycolmap
import pytest
import torch

from snowsplat.data.load import load_dataset
from snowsplat.data.maps.map_files import read_depth_file
from snowsplat.data.readers import NoPosesError, find_poses, photo_folder, read_poses
from snowsplat.data.readers.pose_matrices import LAYOUTS
from snowsplat.data.readers.projects import advice
from snowsplat.pipeline.describe import describe
from snowsplat.util.errors import SettingError, UserError

from . import exports
from .exports import COLORS, HEIGHT, NAMES, POINTS, WIDTH


def pixels(image):
    """(P, 2): where a posed image shows `POINTS`, by the equations of COLMAP."""
    camera, lens = image.camera, image.lens
    pose = camera.cam_from_world.numpy()
    cam = POINTS @ pose[:, :3].T + pose[:, 3]
    assert (lens.width, lens.height) == (camera.width, camera.height)
    assert lens.params[:4] == (camera.fx, camera.fy, camera.cx, camera.cy)
    if lens.model == "BROWN":  # COLMAP does not have it
        return lens.project(cam)
    theirs = pycolmap.Camera(
        model=lens.model, width=lens.width, height=lens.height, params=lens.params
    )
    return np.asarray(theirs.img_from_cam(cam))


CASES = {
    "metashape": (exports.metashape, {}),
    "metashape chunk": (exports.metashape, {"world": False}),
    "metashape r8, skew": (exports.metashape, {"k": (0.1, -0.05, 0.03, -0.04), "b2": -1.3}),
    "metashape fisheye": (exports.metashape, {"kind": "fisheye", "k": (0.1, -0.02, 0.01, 0.004)}),
    "realityscan": (exports.realityscan, {}),
    "realityscan 2": (exports.realityscan, {"newer": True}),
    "bundler": (exports.bundler, {}),
    "polycam": (exports.polycam, {}),
    "polycam arkit": (exports.polycam, {"corrected": False}),
    "polycam 2025": (exports.polycam, {"sizes": False}),
    "record3d": (exports.record3d, {}),
    "record3d rows": (exports.record3d, {"rows": True}),
    "openmvg": (exports.openmvg, {}),
    "openmvg fisheye": (exports.openmvg, {"kind": "fisheye"}),
    "opensfm": (exports.opensfm, {}),
    "opensfm perspective": (exports.opensfm, {"kind": "perspective"}),
    "opensfm fisheye": (exports.opensfm, {"kind": "fisheye"}),
    "alicevision": (exports.alicevision, {}),
    "alicevision 1.2.0": (exports.alicevision, {"newer": False}),
    "llff": (exports.llff, {}),
    "realitycapture": (exports.realitycapture, {}),
    **{layout.name: (exports.matrices, {"layout": layout.name}) for layout in LAYOUTS},
}


@pytest.mark.parametrize("case", CASES)
def test_points_are_projected_as_by_the_program(case, tmp_path):
    write, options = CASES[case]
    expected = write(tmp_path, **options)
    found = read_poses(tmp_path)
    assert len(found.images) == len(NAMES)
    for image in found.images:
        assert image.path.is_file()
        assert np.abs(pixels(image) - expected[image.path.name]).max() < 1e-6
    if found.points is not None:
        xyz = found.points.xyz.float()
        assert torch.allclose(xyz, torch.from_numpy(POINTS).float(), atol=1e-5)
    assert f"{len(NAMES)} of" in str(found.description)


def test_the_description_tells_what_was_read(tmp_path):
    exports.metashape(tmp_path)
    found = read_poses(tmp_path)
    assert str(found.description) == (
        "Metashape cameras.xml, 4 of 5 photos aligned, points from points.ply"
    )
    assert found.points is not None
    assert found.points.rgb.tolist() == COLORS.tolist()


def test_points_in_the_frame_of_the_chunk_are_moved_to_the_world(tmp_path):
    exports.metashape(tmp_path)
    turn, shift, scale = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3]), 2.5
    exports.points(tmp_path, (POINTS - shift) @ turn / scale)
    exports.painted_photos(tmp_path / "images")
    points = read_poses(tmp_path).points
    assert points is not None
    assert torch.allclose(points.xyz.float(), torch.from_numpy(POINTS).float(), atol=1e-5)


def test_points_in_another_frame_are_not_used(tmp_path, caplog):
    exports.realityscan(tmp_path)
    exports.points(tmp_path, POINTS + 100)
    found = read_poses(tmp_path)
    assert found.points is None
    assert "points" not in str(found.description)
    assert "are not where the cameras look" in caplog.text


def test_cameras_on_the_earth_get_a_local_frame(tmp_path):
    expected = exports.metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    file.write_text(file.read_text().replace("1.0 2.0 3.0", "4200000.0 500000.0 4750000.0"))
    posed = read_poses(tmp_path).images
    centres = torch.stack([image.camera.position for image in posed])
    assert centres.mean(0).abs().max() < 1e-6
    a, b = centres[0] - centres[1], centres[0] - centres[2]
    truth = [-r.T @ t for r, t in exports.rig().values()]
    assert float(a.norm()) == pytest.approx(np.linalg.norm(truth[0] - truth[1]), rel=1e-9)
    assert float(b.norm()) == pytest.approx(np.linalg.norm(truth[0] - truth[2]), rel=1e-9)
    assert set(expected) == {image.path.name for image in posed}


def test_a_document_type_is_refused(tmp_path):
    exports.metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    start, end = file.read_text().split("<document", 1)
    bomb = '<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;&a;">]>'
    file.write_text(f"{start}{bomb}<document{end}")
    with pytest.raises(UserError, match="has a document type"):
        read_poses(tmp_path)


def test_the_message_about_an_unknown_encoding_is_short(tmp_path):
    exports.metashape(tmp_path)
    file = tmp_path / "cameras.xml"
    file.write_text(file.read_text().replace("UTF-8", "UTF" + 500 * "-8"))
    with pytest.raises(UserError, match="not a complete XML file .'unknown encoding") as refused:
        read_poses(tmp_path)
    assert len(str(refused.value)) < len(str(file)) + 200


def test_depth_maps_have_a_unit(tmp_path):
    exports.polycam(tmp_path)
    dataset = load_dataset(tmp_path, hold_out=None)
    assert [view.depth_unit for view in dataset.train] == [1e-3] * len(NAMES)
    assert dataset.metres_per_unit == 1
    assert all(view.depth is not None for view in dataset.train)
    assert all(view.depth_confidence.parent.name == "confidence" for view in dataset.train)
    assert str(dataset.description) == "Polycam corrected_cameras, 4 of 4 photos aligned"


def test_keyframes_without_poses_are_photos(tmp_path):
    exports.polycam(tmp_path, corrected=False)
    for file in (tmp_path / "keyframes" / "cameras").iterdir():
        file.write_text(json.dumps({"fx": 500, "t_00": 1}))
    assert find_poses(tmp_path) is None
    assert photo_folder(tmp_path) == ("Polycam", tmp_path / "keyframes" / "images")


def test_the_file_of_the_cameras_can_be_given(tmp_path):
    exports.bundler(tmp_path)
    assert len(read_poses(tmp_path / "bundle.out").images) == len(NAMES)


def test_a_list_that_starts_with_its_length(tmp_path):
    exports.bundler(tmp_path)
    expected = [image.path.name for image in read_poses(tmp_path).images]
    file = tmp_path / "list.txt"
    file.write_text(f"{len(NAMES) + 1}\n{file.read_text()}")
    assert [image.path.name for image in read_poses(tmp_path).images] == expected


def test_photos_elsewhere_are_one_line(tmp_path):
    exports.realityscan(tmp_path)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(
        UserError, match=r"none of its 4 photos .*'a\.png'.*; copy them to .*images"
    ):
        read_poses(tmp_path)


def test_missing_photos_are_skipped(tmp_path, caplog):
    exports.openmvg(tmp_path)
    (tmp_path / "images" / "b.png").unlink()
    found = read_poses(tmp_path)
    assert [image.path.name for image in found.images] == ["a.png", "c.png", "d.png"]
    assert "1 of 4 photos are missing (the first is '/b.png')" in caplog.text
    assert "4 of 5 photos aligned" in str(found.description)


def test_photos_are_found_in_other_folders_and_with_other_suffixes(tmp_path):
    exports.alicevision(tmp_path)
    (tmp_path / "images").rename(tmp_path / "Photos of Monday")
    (tmp_path / "Photos of Monday" / "a.png").rename(tmp_path / "Photos of Monday" / "A.PNG")
    exports.photos(tmp_path / "images_2", size=(WIDTH // 2, HEIGHT // 2))
    names = {image.path.name for image in read_poses(tmp_path).images}
    assert names == {"A.PNG", "b.png", "c.png", "d.png"}


def test_another_folder_of_images_can_be_chosen(tmp_path):
    exports.llff(tmp_path)
    exports.photos(tmp_path / "images_2", size=(WIDTH // 2, HEIGHT // 2))
    dataset = load_dataset(tmp_path, images="images_2", hold_out=None)
    assert dataset.train[0].name == "images_2/a.png"
    assert dataset.train[0].camera.fx == pytest.approx(55 / 2)
    with pytest.raises(SettingError, match="no such folder"):
        load_dataset(tmp_path, images="images_8")


def test_equal_names_are_told_apart_by_their_folder(tmp_path):
    exports.alicevision(tmp_path)
    (tmp_path / "images").rename(tmp_path / "photos")
    exports.photos(tmp_path / "retouched")
    posed = read_poses(tmp_path).images  # the file has /home/me/photos/
    assert {image.folder.name for image in posed} == {"photos"}
    (tmp_path / "photos").rename(tmp_path / "other")
    with pytest.raises(UserError, match=r"several photos named 'a\.png'"):
        read_poses(tmp_path)


def test_equal_labels_of_metashape_are_told_apart_by_their_group(tmp_path):
    exports.metashape(tmp_path)
    path = tmp_path / "cameras.xml"
    text = path.read_text().replace('label="b"', 'label="a"')
    text = text.replace('<camera id="1"', '<group label="two"><camera id="1"')
    path.write_text(text.replace("</cameras>", "</group></cameras>"))
    (tmp_path / "images/two").mkdir()
    for name in ("b.png", "c.png", "d.png"):
        new = "a.png" if name == "b.png" else name
        (tmp_path / "images" / name).rename(tmp_path / "images/two" / new)
    assert {image.name for image in read_poses(tmp_path).images} >= {
        "images/a.png",
        "images/two/a.png",
    }


def test_a_broken_pose_in_a_table(tmp_path, caplog):
    exports.llff(tmp_path)
    poses = np.load(tmp_path / "poses_bounds.npy")
    poses[1, 3] = np.inf
    np.save(tmp_path / "poses_bounds.npy", poses)
    assert len(load_dataset(tmp_path, hold_out=None).train) == len(poses) - 1
    assert "left out: images/b.png" in caplog.text


def test_no_photo_outside_of_the_folder_is_used(tmp_path):
    folder = tmp_path / "dataset"
    folder.mkdir()
    exports.opensfm(folder)
    shutil.move(folder / "images", tmp_path / "images")
    file = folder / "reconstruction.json"
    file.write_text(file.read_text().replace('"a.png"', '"../images/a.png"'))
    with pytest.raises(UserError, match="none of its 4 photos"):
        read_poses(folder)


def test_positions_in_degrees_are_refused(tmp_path):
    exports.realityscan(tmp_path)
    file = tmp_path / "cameras.csv"
    lines = [line.split(",") for line in file.read_text().splitlines()]
    for line in lines[1:]:
        line[1:3] = str(8.5 + float(line[1]) / 1e5), str(47.3 + float(line[2]) / 1e5)
    file.write_text("\n".join(map(",".join, lines)))
    with pytest.raises(UserError, match="longitude and latitude; export"):
        read_poses(tmp_path)


def test_a_table_of_positions_alone_is_explained(tmp_path):
    exports.photos(tmp_path)
    (tmp_path / "cameras.csv").write_text("#name,x,y,alt\na.png,1,2,3\n")
    with pytest.raises(UserError, match="export the alignment as Internal/External"):
        read_poses(tmp_path)


def test_lenses_with_k1_alone_are_in_doubt(tmp_path, caplog):
    exports.realityscan(tmp_path)
    file = tmp_path / "cameras.csv"
    lines = [line.split(",") for line in file.read_text().splitlines()]
    for line in lines[1:]:
        line[11:] = ["0"] * 5
    file.write_text("\n".join(map(",".join, lines)))
    read_poses(tmp_path)
    assert "division model" in caplog.text


def test_compressed_depth_maps_are_named(tmp_path, caplog):
    exports.record3d(tmp_path)
    (tmp_path / "rgb").rename(tmp_path / "rgbd")
    (tmp_path / "rgbd" / "0.depth").write_bytes(b"bvx2")
    read_poses(tmp_path)
    assert "LZFSE" in caplog.text


def test_packed_recordings_are_to_be_unpacked(tmp_path):
    (tmp_path / "scan.r3d").write_bytes(b"PK")
    with pytest.raises(UserError, match=r"scan\.r3d: is packed; unpack it"):
        load_dataset(tmp_path / "scan.r3d")


def test_info_describes_the_file_of_the_cameras(tmp_path):
    exports.metashape(tmp_path)
    facts = describe(tmp_path / "cameras.xml")
    assert str(facts["description"]).startswith("Metashape cameras.xml, 4 of 5 photos aligned")
    assert facts["points"] == len(POINTS)


def test_the_folder_of_an_unpacked_archive_may_be_inside(tmp_path):
    (tmp_path / "scan").mkdir()
    (tmp_path / "__MACOSX").mkdir()
    exports.polycam(tmp_path / "scan")
    posed = read_poses(tmp_path).images
    assert len(posed) == len(NAMES)
    photos = tmp_path / "scan" / "keyframes" / "corrected_images"
    assert photo_folder(tmp_path) == ("Polycam", photos)


UNREAD = "garden.psx Garden.rcproj sfm_data.bin scan.r3d a.nvm calibrated_camera_parameters.txt"


@pytest.mark.parametrize(
    "name", [*UNREAD.split(), "b/a.mvs", "kapture/sensors/trajectories.txt", "sparse/0/cameras.bin"]
)
def test_projects_that_are_not_readable_are_explained(name, tmp_path):
    exports.photos(tmp_path / "images")
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    with pytest.raises(NoPosesError, match=rf"{name} is .*; (export|convert|unpack|put)"):
        load_dataset(tmp_path)
    assert f"{name} is " in str(describe(tmp_path)["camera_poses"])


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.nvm", "NVM_V3", "a.nvm is a file of VisualSFM; export bundle.out and list.txt$"),
        ("a.obj", "v 0 0 0", "not a known scene file.*, checkpoints, datasets, photos and videos$"),
        ("a.ply", "version https://git-lfs.github.com/spec/v1\n", "run git lfs pull$"),
    ],
)
def test_other_files_are_explained(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=message):
        describe(tmp_path / name)


def test_an_export_in_a_folder_without_photos_is_that_of_the_photos_above(tmp_path):
    exports.alicevision(tmp_path)
    (tmp_path / "cache/0a1b").mkdir(parents=True)
    [file] = tmp_path.glob("*.sfm")
    file.rename(tmp_path / "cache/0a1b/cameras.sfm")
    assert len(read_poses(tmp_path).images) == 4
    exports.photos(tmp_path / "cache/0a1b")  # a dataset of its own
    assert find_poses(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "text", "program"),
    [
        ("pose/0.txt", "1 0 0 0\n0 1 0 0\n", "ScanNet"),
        ("groundtruth.txt", "# time x y z\n1.5 0 0 1 0 0 0 1\n", "TUM"),
        ("poses.txt", "1e0 0 0 0 0 1 0 0 0 0 1 0\n", "KITTI"),
        ("frame-000000.pose.txt", "1 0 0 0\t\n0 1 0 0\n", "7-Scenes"),
        ("a/b.txt", "1 0 0 0\n", None),
        ("poses.txt", "poses: none\n", None),
    ],
)
def test_poses_without_a_camera_are_named(tmp_path, name, text, program):
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    found = advice(tmp_path)
    assert (found is None) == (program is None)
    first = name.partition("/")[0]
    assert program is None or f"{first!r} has camera poses in the layout of {program}" in str(found)


def test_depth_maps_of_layouts_have_the_unit_of_their_program(tmp_path):
    for layout in ("ScanNet", "TUM", "Replica", "3d Scanner App"):
        exports.matrices(tmp_path / layout, layout)
        found = read_poses(tmp_path / layout)
        for image in found.images:
            assert float(read_depth_file(image.depth).mean()) * image.depth_unit == pytest.approx(
                1.25, abs=1e-3
            )
        assert found.metres_per_unit == 1.0


def test_a_frame_without_tracking_and_a_damaged_one(tmp_path, caplog):
    exports.matrices(tmp_path, "ScanNet")
    (tmp_path / "pose/2.txt").write_text("1 0 0 x\n")
    found = read_poses(tmp_path)
    assert [image.path.name for image in found.images] == ["0.jpg", "1.jpg", "3.jpg"]
    assert "3 of 5 photos aligned" in str(found.description)
    assert "should be numbers" in caplog.text


def test_the_prefix_of_a_pose_of_nsvf_is_its_split(tmp_path):
    exports.matrices(tmp_path, "NSVF")
    found = {image.path.name: image.split for image in read_poses(tmp_path).images}
    assert found["0_0002.png"] == "train"
    assert found["1_0003.png"] == "test"


def test_the_cameras_of_tum_are_known_by_their_names(tmp_path):
    folder = tmp_path / "rgbd_dataset_freiburg3_office"
    exports.matrices(folder, "TUM")
    (folder / "intrinsics.txt").unlink()
    assert read_poses(folder).images[0].lens.params[0] == 535.4


@pytest.mark.parametrize(
    ("old", "new"),
    [("brown3t2", "division"), ('Skew="0"', 'Skew="0.1"'), ("</rdf:RDF>", "")],
)
def test_a_lens_model_of_realitycapture_that_is_not_read(tmp_path, caplog, old, new):
    exports.realitycapture(tmp_path)
    file = tmp_path / "b.xmp"
    file.write_text(file.read_text().replace(old, new))
    assert len(read_poses(tmp_path).images) == 3
    assert "1 of 4 photos are left out: b.xmp" in caplog.text


def test_other_files_are_no_exports(tmp_path):
    exports.photos(tmp_path)
    (tmp_path / "notes.xml").write_text("<notes><chunk/></notes>")
    (tmp_path / "prices.csv").write_text("name,price\na,1\n")
    (tmp_path / "metadata.json").write_text("{}")
    (tmp_path / "a.out").write_bytes(b"\x7fELF")
    assert find_poses(tmp_path) is None


def test_a_dataset_is_loaded(tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    exports.llff(tmp_path)
    dataset = load_dataset(tmp_path, hold_out=2)
    assert [view.name for view in dataset.test] == ["images/a.png", "images/c.png"]
    assert {(view.camera.width, view.camera.height) for view in dataset.train} == {(WIDTH, HEIGHT)}
    assert dataset.train[0].camera.fx == 55
    assert str(dataset.description) == "LLFF poses_bounds.npy, 4 of 4 photos aligned"


def test_nerfcapture_has_depth_maps_with_a_unit(tmp_path):
    matrix = np.eye(4).tolist()
    frames = [{"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"} for i in range(2)]
    for i, frame in enumerate(frames):
        matrix[0][3] = float(i)
        frame["transform_matrix"] = [row[:] for row in matrix]
    exports.photos(tmp_path / "images", ["0.png", "1.png", "0.depth.png", "1.depth.png"])
    scene = {"fl_x": 50.0, "fl_y": 50.0, "cx": 32.0, "cy": 24.0, "w": WIDTH, "h": HEIGHT}
    scene |= {"integer_depth_scale": 10 / 65535, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(scene))
    views = load_dataset(tmp_path, hold_out=None).train
    assert [view.depth.name for view in views] == ["0.depth.png", "1.depth.png"]
    assert [view.depth_unit for view in views] == [10 / 65535] * 2
