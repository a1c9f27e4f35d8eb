"""Real datasets outside the project: their known contents, and that poses match the images."""

from pathlib import Path

import pytest
import torch

from snowsplat.data import ImageLoader, load_dataset

CAPTURES = Path(__file__).resolve().parents[3] / "shared" / "captures"


def load(name, **options):
    if not (CAPTURES / name).is_dir():
        pytest.skip(f"no real dataset at ../shared/captures/{name}")
    return load_dataset(CAPTURES / name, **options)


@pytest.mark.parametrize(
    ("name", "train", "test", "size", "points"),
    [
        ("fox", 43, 7, (552, 986), 11_236),
        ("fox_small", 43, 7, (270, 480), 8_947),
        ("fern", 17, 3, (988, 741), 5_785),
        ("kitchen25", 21, 3, (999, 666), 2_401),
        ("lego400", 50, 13, (400, 400), None),
    ],
)
def test_contents(name, train, test, size, points):
    dataset = load(name)
    assert (len(dataset.train), len(dataset.test)) == (train, test)
    cameras = [view.camera for view in dataset.train + dataset.test]
    assert {(camera.width, camera.height) for camera in cameras} == {size}
    assert (dataset.points and len(dataset.points)) == points
    low, high = dataset.bounds
    if points is None:
        assert torch.allclose(torch.stack([-low, high]), torch.tensor(1.3), atol=0.05)
    else:
        xyz = dataset.points.xyz
        assert ((xyz > low) & (xyz < high)).all(1).float().mean() > 0.9


def colour_errors(view, points, image, shifts):
    """For each shift in pixels: the median colour difference of points and shifted pixels."""
    pixels, depth = view.camera.project(points.xyz.double())
    size = torch.tensor([view.camera.width, view.camera.height])
    errors = []
    for shift in shifts:
        shifted = pixels + torch.tensor(shift)
        inside = (depth > 0) & (shifted >= 0).all(1) & (shifted < size).all(1)
        column, row = shifted[inside].long().T
        difference = image[row, column].int() - points.rgb[inside].int()
        errors.append(difference.abs().float().mean(1).median())
    return torch.stack(errors)


@pytest.mark.parametrize("name", ["fox", "fox_small", "fern", "kitchen25"])
@pytest.mark.parametrize("resolution", [1, 2])
def test_points_project_to_pixels_of_their_colour(name, resolution):
    """A shift by two pixels of the original photo, in any direction, increases the error."""
    dataset = load(name, resolution=resolution, hold_out=None)
    views = dataset.train[::8]
    near, far = 2 / resolution, views[0].camera.width / 10
    shifts = [(0.0, 0.0), (near, 0.0), (-near, 0.0), (0.0, near), (0.0, -near), (far, 0.0)]
    with ImageLoader(views) as loader:
        errors = sum(colour_errors(v, dataset.points, loader.get(v).rgb, shifts) for v in views)
    assert errors[0] < 0.95 * errors[1:5].min()
    assert errors[0] < 0.7 * errors[5]


def test_lego_is_in_the_middle_of_its_transparent_images():
    """The opaque pixels are where the poses of transforms.json project a box around the model."""
    dataset = load("lego400")
    corners = torch.cartesian_prod(*[torch.tensor([-0.7, 0.7], dtype=torch.float64)] * 3)
    view = dataset.train[0]
    with ImageLoader([view]) as loader:
        alpha = loader.get(view).alpha
    assert alpha is not None
    rows, columns = (alpha > 128).nonzero().T
    opaque = torch.stack([columns, rows], 1).double().mean(0)
    assert (view.camera.project(corners)[0].mean(0) - opaque).abs().max() < 30
