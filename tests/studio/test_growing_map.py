"""The map and the photos while poses are found."""

import numpy as np
from PIL import Image

from snowsplat.sfm.report.scene_map import PlacedPhoto
from snowsplat.studio.recorder import Recorder
from snowsplat.util.stages import Outcome


def standing(x: float) -> np.ndarray:
    """The pose of a camera at (x, 0, 0) in a frame where z points up."""
    rotation = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    return np.column_stack([rotation, -rotation @ [x, 0, 0]])


def test_photos_are_placed_one_by_one(studio):
    scene = studio.library.new("a", [])
    for folder, names in (("input/walk", "abc"), ("images", "z")):  # images of an earlier job
        (scene.made / "dataset" / folder).mkdir(parents=True)
        for name in names:
            Image.new("RGB", (30, 20)).save(scene.made / "dataset" / folder / f"{name}.jpg")
    address = f"scenes/{scene.name}"
    assert studio.ask(f"{address}/photos")[1] == [{"name": "z.jpg", "placed": True}]
    recorder = Recorder(scene)
    recorder.begin("poses")
    cloud = np.random.default_rng(0).uniform((-1, 3, -1), (1, 5, 1), (50, 3))
    drawn = set()
    for count in (2, 3):
        names = [f"walk/{letter}.jpg" for letter in "abc"[:count]]
        photos = [PlacedPhoto(n, None, standing(i), 0.5, 0.4) for i, n in enumerate(names)]
        recorder.show_poses(photos, cloud)
        answer = studio.ask(address)[1]
        assert "placed" not in answer["state"]  # there may be thousands
        drawn.add(answer["map"])
        svg = studio.ask(f"{address}/map")[1].decode()
        assert svg.count("<title>walk/") == count
        listed = [each["placed"] for each in studio.ask(f"{address}/photos")[1]]
        assert listed == [True, True, count == 3]
    assert len(drawn) == 2  # the page sees that there is another one
    # From above: the cameras stand side by side, and the points are in front of them.
    width, height = (float(v) for v in svg.split('viewBox="0 0 ')[1].split('"')[0].split())
    assert height > width / 2
    facts = {"registered": names, "unregistered": {}, "points": 50, "reprojection_error": 0.5}
    result = facts | {"sub_models": [3], "attempts": ["one"]}
    recorder.end("poses", Outcome(result, 1.0, False))
    assert studio.ask(f"{address}/photos")[1] == [{"name": "z.jpg", "placed": True}]
