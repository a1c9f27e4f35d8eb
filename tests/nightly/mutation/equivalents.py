"""Faults that have no observable effect, with the reason for each.

A fault is identified by its file and by the changed lines before and after the change, so its
position in the file does not matter. mutate.py reports entries that match no fault.
"""

from __future__ import annotations

#: {(file in the package, lines before, lines after): why no test can detect the fault}
EQUIVALENTS: dict[tuple[str, str, str], str] = {
    (
        "training/step/losses.py",
        "target = photo.rgb if photo.alpha is None else photo.over(background)",
        "target = photo.rgb if (photo.alpha is None) and False else photo.over(background)",
    ): "an opaque photo over a background is that photo; 8 bits only save memory",
    (
        "training/density/adaptive.py",
        "large |= torch.where(split, size / SPLIT_SHRINK, size) > settings.prune_world_size",
        "large = torch.where(split, size / SPLIT_SHRINK, size) > settings.prune_world_size",
    ): "nothing is large before this line",
    (
        "training/density/adaptive.py",
        "grads = self.grad_sum / self.views.clamp_min(1.0)",
        "grads = self.grad_sum / self.views.clamp_min(0.9375)",
    ): "the number of views is an integer; where it is 0, the sum is 0",
    (
        "training/density/mcmc.py",
        "NOISE_NEGLIGIBLE = 1e-4",
        "NOISE_NEGLIGIBLE = 9.375e-05",
    ): "any limit of a similar size is suitable",
    (
        "scene/geometry.py",
        "degenerate = right.norm(dim=-1, keepdim=True) < 1e-6 * up.norm(dim=-1, keepdim=True)",
        "degenerate = right.norm(dim=-1, keepdim=True) <= 1e-6 * up.norm(dim=-1, keepdim=True)",
    ): "rounding decides at equality; it is exact only for up = 0, which has no meaning",
    (
        "scene/edit.py",
        "azimuth = index * (math.pi * (3.0 - math.sqrt(5.0)))",
        "azimuth = index / (math.pi * (3.0 - math.sqrt(5.0)))",
    ): "any directions that determine the coefficients give the same matrices",
    (
        "scene/edit.py",
        "identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=dtype)",
        "identity = torch.tensor([2.0, 0.0, 0.0, 0.0], dtype=dtype)",
    ): "quaternions need not be normalised",
    (
        "trajectory/focus.py",
        "across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]",
        "across = torch.eye(3, dtype=None) - forward[:, :, None] * forward[:, None, :]",
    ): "0 and 1 are exact in float32, and the difference is float64",
    (
        "trajectory/video_file.py",
        "src_color_range=ColorRange.JPEG,",
        "",
    ): "FFmpeg assumes the full range for RGB by default",
    (
        "trajectory/spline.py",
        "if count > 2:",
        "if count >= 2:",
    ): "with two samples every array of this block is empty",
    (
        "trajectory/spline.py",
        "i = torch.searchsorted(self._times, t, right=True).clamp(1, len(self._times) - 1) - 1",
        "i = torch.searchsorted(self._times, t, ).clamp(1, len(self._times) - 1) - 1",
    ): "at a knot the pieces on both sides have the same value",
    (
        "trajectory/follow.py",
        "differ = torch.cat([torch.tensor([True]), _steps(positions, quats, distance) > 1e-6])",
        "differ = torch.cat([torch.tensor([True]), _steps(positions, quats, distance) >= 1e-6])",
    ): "rounding decides at equality",
    (
        "ops/reference.py",
        "order = torch.argsort(splats.depths.detach(), stable=True)",
        "order = torch.argsort(splats.depths.detach(), stable=False)",
    ): "on the CPU torch sorts stably anyway",
    (
        "ops/reference.py",
        "first = torch.tensor([left + 0.5, top + 0.5]).to(means2d)",
        "first = torch.tensor([left - 0.5, top + 0.5]).to(means2d)",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "ops/reference.py",
        "first = torch.tensor([left + 0.5, top + 0.5]).to(means2d)",
        "first = torch.tensor([left + 0.5, top - 0.5]).to(means2d)",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "ops/reference.py",
        "last = torch.tensor([left + w - 0.5, top + h - 0.5]).to(means2d)",
        "last = torch.tensor([left + w - 0.5, top + h - 0.46875]).to(means2d)",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "ops/reference.py",
        "low, high = means2d - half_extent - 1e-3, means2d + half_extent + 1e-3",
        "low, high = means2d - half_extent - 0.0009375, means2d + half_extent + 1e-3",
    ): "any margin larger than the rounding error is sufficient",
    (
        "ops/reference.py",
        "low, high = means2d - half_extent - 1e-3, means2d + half_extent + 1e-3",
        "low, high = means2d - half_extent - 1e-3, means2d + half_extent + 1.001",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "data/colmap/binary.py",
        '+ image.name.encode("utf-8", errors="surrogateescape")',
        '+ image.name.encode(errors="surrogateescape")',
    ): "UTF-8 is the default",
    (
        "data/photos/decode.py",
        "colours = (colours + (1 - alpha) * behind).clip(0, 255)",
        "colours = (colours + (1 - alpha) * behind).clip(None, 255)",
    ): "the sum of values that are not negative is not negative",
    (
        "data/photos/image_file.py",
        "header = start + file.read(_LONGEST_HEADER)",
        "header = start + file.read(None)",
    ): "more is read than is needed",
    (
        "scene/geometry.py",
        "signs = torch.ones(3, dtype=torch.float64)",
        "signs = torch.ones(3, )",
    ): "1 and -1 are exact in float32",
    (
        "scene/edit.py",
        "azimuth = index * (math.pi * (3.0 - math.sqrt(5.0)))",
        "azimuth = index * (math.pi / (3.0 - math.sqrt(5.0)))",
    ): "any directions that determine the coefficients give the same matrices",
    (
        "scene/orientation.py",
        "up = mean / max(float(np.linalg.norm(mean)), 1e-12)",
        "up = mean / max(float(np.linalg.norm(mean)), 9.375e-13)",
    ): "any small number avoids the division by 0",
    (
        "ops/reference.py",
        "rows_of = nonfinite.reshape(len(p), -1) if p.numel() else nonfinite.new_zeros(0, 1)",
        "rows_of = nonfinite.reshape(len(p), -1) if p.numel() else nonfinite.new_zeros(1, 1)",
    ): "a row without values is not counted either way",
    (
        "formats/glb.py",
        'text = json.dumps(document, separators=(",", ":")).encode()',
        "text = json.dumps(document, ).encode()",
    ): "white space in JSON",
    (
        "formats/packing.py",
        "steps = np.arange(256, dtype=np.float64)",
        "steps = np.arange(257, dtype=np.float64)",
    ): "no byte is the index of the last one",
    (
        "trajectory/follow.py",
        "order = torch.tensor(tour, dtype=torch.int64)",
        "order = torch.tensor(tour, dtype=None)",
    ): "torch makes int64 of Python's integers",
    (
        "trajectory/follow.py",
        "quats = torch.cat([quats[:1], quats[1:] * signs[:, None].to(quats.dtype)])",
        "quats = torch.cat([quats[:1], quats[1:] / signs[:, None].to(quats.dtype)])",
    ): "signs are 1 or -1",
    (
        "trajectory/follow.py",
        'return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]',
        'return [(int(part), "XXXX") if part.isdecimal() else (-1, part) for part in parts]',
    ): "all numbers have the same second part",
    (
        "trajectory/spline.py",
        "near, far = [*beside.tolist(), 0.0], [*beyond.tolist(), 0.0, 0.0]",
        "near, far = [*beside.tolist(), 1.0], [*beyond.tolist(), 0.0, 0.0]",
    ): "the last factor is never used",
    (
        "training/core/view_queue.py",
        "LOOKAHEAD = 16",
        "LOOKAHEAD = 17",
    ): "how far ahead photos are decoded; their order is the same",
    (
        "data/readers/transforms_json.py",
        '_Split = Literal["train", "test"]',
        '_Split = Literal["XXtrainXX", "test"]',
    ): "it is used in annotations only",
    (
        "data/photos/image_loader.py",
        'self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="snowsplat-images")',
        'self._pool = ThreadPoolExecutor(self._threads, thread_name_prefix="XXsnowsplat-imagesXX")',
    ): "names of threads are shown by debuggers only",
    (
        "data/colmap/binary.py",
        'record = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])',
        'record = np.dtype([("XXidXX", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3)])',
    ): "the field is not read; it moves the others to their offsets",
    (
        "data/points_ply.py",
        "values = np.nan_to_num(values.astype(np.float32)) * 255.0 + 0.5",
        "values = np.nan_to_num(values.astype(None)) * 255.0 + 0.5",
    ): "float64 differs only where rounding decides between two colours",
    (
        "formats/ksplat.py",
        'means: np.ndarray = rows["means"].astype(np.float32)',
        'means: np.ndarray = rows["means"].astype(None)',
    ): "the result is float32 in any case; only its rounding may differ",
    (
        "trajectory/spline.py",
        "near, far = [*beside.tolist(), 0.0], [*beyond.tolist(), 0.0, 0.0]",
        "near, far = [*beside.tolist(), 0.0], [*beyond.tolist(), 0.0, 1.0]",
    ): "the last factor is never used",
    (
        "trajectory/orbit.py",
        "_SAMPLES_PER_FRAME = 20",
        "_SAMPLES_PER_FRAME = 21",
    ): "any density of about this size measures the length well enough",
    (
        "trajectory/orbit.py",
        "_Path = Callable[[Tensor], Tensor]",
        "_Path = None",
    ): "it is used in annotations only",
    (
        "trajectory/video_file.py",
        "dst_color_range=ColorRange.MPEG,",
        "dst_color_range=None,",
    ): "FFmpeg converts to the limited range by default",
    (
        "trajectory/focus.py",
        "return torch.stack([camera.position.detach() for camera in cameras]).to(torch.float64)",
        "return torch.stack([camera.position.detach() for camera in cameras]).to(None)",
    ): "the pose of a camera is float64 already",
    (
        "formats/sog.py",
        "return np.zeros((layout.count, 0, 3), np.float32)",
        "return np.zeros((layout.count, 0, 3), None)",
    ): "`decoded` converts all arrays to float32, and this one is empty",
    (
        "formats/sog.py",
        "return files.image(layout.files[name], n, 4 * n + (1 << 16)).reshape(-1, 4)[:n]",
        "return files.image(layout.files[name], n, 4 * n + (1 << 16)).reshape(-2, 4)[:n]",
    ): "NumPy computes any negative length, not only -1",
    (
        "ops/reference.py",
        "low, high = means2d - half_extent - 1e-3, means2d + half_extent + 1e-3",
        "low, high = means2d - half_extent - 1.001, means2d + half_extent + 1e-3",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "ops/reference.py",
        "last = torch.tensor([left + w - 0.5, top + h - 0.5]).to(means2d)",
        "last = torch.tensor([left + w + 0.5, top + h - 0.5]).to(means2d)",
    ): "a larger rectangle adds splats whose alpha is 0 in all pixels",
    (
        "data/readers/transforms_json.py",
        "u, _, vt = np.linalg.svd(axes / scale if scale > 1e-9 else np.zeros((3, 3)))",
        "u, _, vt = np.linalg.svd(axes / scale if scale > 9.375000000000001e-10 "
        "else np.zeros((3, 3)))",
    ): "a matrix with a scale of at most 1e-9 is rejected either way",
    (
        "data/frame/bounds.py",
        "across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]",
        "across = torch.eye(3, dtype=None) - axes[:, :, None] * axes[:, None, :]",
    ): "0 and 1 are exact in float32, and the difference is float64",
    (
        "data/frame/bounds.py",
        "if float(direction.norm()) > 0.5:",
        "if float(direction.norm()) >= 0.5:",
    ): "rounding decides at equality",
    (
        "data/photos/image_file.py",
        'if any(tile[0] in Image.DECODERS for tile in getattr(image, "tile", ())):',
        'if any(tile[0] in Image.DECODERS for tile in getattr(image, "tile", )):',
    ): "images of all accepted formats have tiles",
    (
        "data/photos/decode.py",
        "colours = (colours + (1 - alpha) * behind).clip(0, 255)",
        "colours = (colours + (1 - alpha) * behind).clip(0, 256)",
    ): "the sum is at most 255, up to rounding",
    (
        "trajectory/follow.py",
        "steps = (steps / steps.mean()).clamp_min(0.05)",
        "steps = (steps / steps.mean()).clamp_min(0.046875)",
    ): "any limit of a similar size is suitable",
    (
        "trajectory/follow.py",
        "while count > 2:",
        "while count > 3:",
    ): "of three places, the first tour is already the shortest: it omits the longest step",
    (
        "data/load.py",
        "usual[folder] = Counter(sorted(factors)).most_common(1)[0][0]",
        "usual[folder] = Counter(sorted(factors)).most_common(2)[0][0]",
    ): "the first entry is the same",
    (
        "trajectory/orbit.py",
        "i = torch.searchsorted(length, wanted).clamp(1, len(t) - 1)",
        "i = torch.searchsorted(length, wanted).clamp(1, len(t) - 2)",
    ): "the last frame is many samples before the end of the path",
    (
        "trajectory/video_file.py",
        "dst_color_range=ColorRange.MPEG,\n)",
        ")",
    ): "FFmpeg converts to the limited range by default",
    (
        "trajectory/follow.py",
        "dense = torch.linspace(start, end, _SAMPLES_PER_FRAME * max(frames, 50), "
        "dtype=torch.float64)",
        "dense = torch.linspace(start, end, _SAMPLES_PER_FRAME * max(frames, 51), "
        "dtype=torch.float64)",
    ): "any density of about this size measures the length well enough",
    (
        "trajectory/orbit.py",
        "share = (wanted - length[i - 1]) / (length[i] - length[i - 1]).clamp_min(1e-300)",
        "share = (wanted - length[i - 1]) / (length[i] - length[i - 1]).clamp_min(9.375e-301)",
    ): "any limit of a similar size is suitable",
    (
        "trajectory/focus.py",
        "if float((right @ DEFAULT_UP).abs().median()) < _LEVEL and float(upper @ DEFAULT_UP) > 0:",
        "if float((right @ DEFAULT_UP).abs().median()) < _LEVEL "
        "and float(upper @ DEFAULT_UP) >= 0:",
    ): "the mean of upward directions is never exactly level",
    (
        "trajectory/video_file.py",
        "_BITS_PER_PIXEL = 0.25",
        "_BITS_PER_PIXEL = 0.234375",
    ): "any bit rate of about this size is suitable",
}
