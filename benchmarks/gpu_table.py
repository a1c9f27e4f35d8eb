"""The findings of `gpu.py` as a page of Markdown. This module only needs Python."""

import math
from collections.abc import Iterable, Sequence

from gpu_floor import Frame, works
from gpu_jobs import Finding, Outcome

#: Names of native functions for readers; functions without one appear under their own name.
NAMES = {
    "project_cull": "project: cull",
    "project_fwd": "project: forward",
    "splats_prepare": "prepare",
    "splats_sort": "sort by depth",
    "tiles_count": "tiles: count",
    "tiles_fill": "tiles: fill, sort",
    "rasterize_fwd": "blend forward",
    "photometric_u8": "photometric",
    "rasterize_bwd": "blend backward",
    "splats_reduce": "reduce",
    "accumulate_screen_statistics": "density statistics",
    "adam_step": "Adam",
}
REST, TOTAL = "rest (PyTorch)", "whole step"
PSNR_GOAL, MEMORY_GOAL, PEER_GOAL = 0.1, 1e9, 2.0
#: Kinds of findings that are repeated; only the last one of a job counts.
_COUNTS = ("tests", "sanitizer")
#: Lines of failures and errors on the page; gpu.json has all.
_MOST_LINES = 12
_MOST_CHARACTERS = 11_000


class Findings:
    """The findings of all children, by job."""

    def __init__(self) -> None:
        self._all: list[tuple[str, Finding]] = []

    def add(self, job: str, found: Finding) -> None:
        if found["kind"] in _COUNTS:
            self._all = [(j, f) for j, f in self._all if (j, f["kind"]) != (job, found["kind"])]
        self._all.append((job, found))

    def of_kind(self, kind: str) -> list[Finding]:
        return [found for _, found in self._all if found["kind"] == kind]

    def last_by_job(self, kind: str) -> dict[str, Finding]:
        return {job: found for job, found in self._all if found["kind"] == kind}

    def one(self, kind: str, **where: object) -> Finding | None:
        """The last finding of a kind with these values."""
        for found in reversed(self.of_kind(kind)):
            if all(found.get(name) == value for name, value in where.items()):
                return found
        return None

    def sizes(self, kind: str) -> list[str]:
        """Sizes, sorted by the number of Gaussians."""
        frames = {found["size"]: found["gaussians"] for found in self.of_kind("frame")}
        sizes = {found["size"] for found in self.of_kind(kind)}
        return sorted(sizes, key=lambda size: (frames.get(size, 0), size))

    def as_json(self) -> list[dict[str, object]]:
        return [{"job": job, **found} for job, found in self._all]

    def wrong(self) -> int:
        """Number of failed tests and sanitizer errors."""
        errors = (found["errors"] for found in self.last_by_job("sanitizer").values())
        return len(self.of_kind("failure")) + sum(errors)


def page(findings: Findings, outcomes: Sequence[Outcome], when: str, running: bool) -> str:
    """The page; its length is limited to 12,000 characters."""
    card = findings.one("device") or findings.one("gpu") or {}
    name = str(card.get("name", "GPU"))
    sections = [
        _machine(findings, name, when, running),
        _tests(findings, name),
        _sanitizer(findings, name),
        _runs(findings, name),
        _training(findings, name),
        _stages(findings, name, in_order=False),
        _steps(findings, name),
        _stages(findings, name, in_order=True),
        _peer(findings, name),
        _jobs(outcomes),
    ]
    text = "\n\n".join(section for section in sections if section) + "\n"
    if len(text) > _MOST_CHARACTERS:
        text = text[:_MOST_CHARACTERS].rpartition("\n")[0] + "\n(cut off; gpu.json has all)\n"
    return text


def _machine(findings: Findings, name: str, when: str, running: bool) -> str:
    lines = [f"# {name}, {when}{' (not finished)' if running else ''}", ""]
    card = findings.one("device")
    if card is not None:
        lines.append(
            f"{name}: compute capability {card['capability']}, {card['multiprocessors']} "
            f"multiprocessors, {card['memory_gb']:.0f} GB, L2 {card['l2_mb']:.0f} MB; as found: "
            f"{card['clocks']}. PyTorch {card['torch']}, Python {card['python']}, "
            f"{card['cores']} cores. Kernels {card['kernels']}."
        )
    bandwidth, rate, mark = (findings.one(kind) for kind in ("bandwidth", "rate", "mark"))
    measured = []
    if bandwidth is not None:
        measured.append(
            f"copying {bandwidth['bytes_a_second'] / 1e12:.2f} TB/s, reads and writes counted"
        )
    if rate is not None:
        measured.append(
            f"{rate['operations_a_second'] / 1e12:.1f}·10¹² float32 multiply-adds per second "
            f"(then: {rate['clocks']})"
        )
    if mark is not None:
        measured.append(f"{1e3 * mark['milliseconds']:.1f} µs between two events")
    if measured:
        lines += ["", f"Measured on {name}: {'; '.join(measured)}."]
    return "\n".join(lines).rstrip()


def _tests(findings: Findings, name: str) -> str:
    by_job = findings.last_by_job("tests")
    if not by_job:
        return ""
    by_job = {job: found for job, found in by_job.items() if found["total"] > 0}
    sums = {key: sum(f[key] for f in by_job.values()) for key in ("passed", "failed", "skipped")}
    total = sum(found["total"] for found in by_job.values())
    left = total - sum(sums.values())
    counts = ", ".join(f"{count} {key}" for key, count in sums.items())
    lines = [
        f"## Tests on {name}",
        "",
        f"{counts}{f', {left} not reached' * (left > 0)}, of {total} in {len(by_job)} files.",
    ]
    failed = findings.of_kind("failure")
    failures = [f"- {found['test']}: {found['line']}"[:200] for found in failed]
    return "\n".join(lines + _some(failures))


def _sanitizer(findings: Findings, name: str) -> str:
    found = findings.last_by_job("sanitizer").values()
    if not found:
        return ""
    lines = [f"## compute-sanitizer on {name}: every op, a training step", ""]
    for f in found:
        reached = "" if f["finished"] else f"; not finished, at: {f['last'] or 'the start'}"
        lines.append(f"- {f['tool']}: {f['errors']} errors{reached}")
        lines += [f"  - {line}" for line in f["lines"]]
    return "\n".join(lines[: 2 + 2 * _MOST_LINES])


def _training(findings: Findings, name: str) -> str:
    rows = []
    key = ("dataset", "iterations", "seed")
    runs = {tuple(f[k] for k in key): {} for f in findings.of_kind("training")}
    for found in findings.of_kind("training"):
        runs[tuple(found[k] for k in key)][found["device"]] = found
    differences: dict[str, list[float]] = {}
    for (dataset, iterations, seed), by_device in sorted(runs.items()):
        cpu, gpu = by_device.get("cpu"), by_device.get("cuda")
        difference = "—"
        if cpu and gpu:
            differences.setdefault(dataset, []).append(gpu["psnr"] - cpu["psnr"])
            difference = f"{differences[dataset][-1]:+.2f}"
        cells = [f"{dataset}", f"{iterations}", f"{seed}"]
        cells += [f"{cpu['psnr']:.2f}" if cpu else "—", f"{gpu['psnr']:.2f}" if gpu else "—"]
        cells += [difference, f"{cpu['seconds']:.1f}" if cpu else "—"]
        if gpu:
            cells += [f"{gpu['seconds']:.1f}", f"{gpu['iterations'] / gpu['seconds']:.0f}"]
            cells += [f"{gpu['gaussians']:,}", f"{gpu['peak'] / 1e6:.0f}"]
            cells += [f"{gpu['psnr_on_cpu'] - gpu['psnr']:+.3f}" if gpu["psnr_on_cpu"] else "—"]
        else:
            cells += ["—"] * 5
        rows.append(cells)
    absent = sorted({found["dataset"] for found in findings.of_kind("absent")})
    if not rows and not absent:
        return ""
    lines = [f"## Training on {name}, PSNR of held-out photos in dB", ""]
    if rows:
        head = "dataset,steps,seed,CPU,GPU,difference,CPU s,GPU s,steps/s,Gaussians,peak MB"
        lines += _table([*head.split(","), "rendered by the CPU"], rows)
    for dataset, found in differences.items():
        mean = sum(found) / len(found)
        verdict = "within" if abs(mean) <= PSNR_GOAL else "NOT within"
        lines += ["", f"{dataset}: mean difference {mean:+.3f} dB, {verdict} {PSNR_GOAL} dB."]
    if absent:
        lines += ["", f"Missing, so not trained: {', '.join(absent)}."]
    return "\n".join(lines)


def _runs(findings: Findings, name: str) -> str:
    rows = []
    for found in findings.of_kind("run"):
        training = "—" if found["training"] is None else f"{found['training']:.1f}"
        cells = [found["dataset"], found["arguments"], found["size"], f"{found['steps']:,}"]
        cells += [f"{found['gaussians']:,}", f"{found['seconds']:.1f}", training]
        rows.append([*cells, f"{found['psnr']:.2f}", f"{found['ssim']:.3f}"])
    if not rows:
        return ""
    head = "dataset,arguments,photos,steps,Gaussians,seconds,of them steps,PSNR,SSIM"
    lines = [f"## {name}: whole runs of `snowsplat train`", ""]
    return "\n".join(lines + _table(head.split(","), rows))


def _stages(findings: Findings, name: str, in_order: bool) -> str:
    sizes = findings.sizes("stages")
    by_size = {size: findings.one("stages", size=size, in_order=in_order) for size in sizes}
    sizes = [size for size in sizes if by_size[size] is not None]
    if not sizes:
        return ""
    bandwidth, rate = findings.one("bandwidth"), findings.one("rate")
    columns = {}
    for size in sizes:
        found, frame = by_size[size], findings.one("frame", size=size)
        assert found is not None
        floors = _floors(frame, in_order, bandwidth, rate)
        columns[size] = _column(found, findings.one("step", size=size, in_order=in_order), floors)
    order = list(NAMES) if any(columns.values()) else []
    names = [n for n in order if any(n in column for column in columns.values())]
    names += sorted({n for c in columns.values() for n in c} - {*names, REST, TOTAL})
    names += [REST, TOTAL]
    if in_order:  # only the functions that differ
        names = [n for n in names if n in ("tiles_fill", "rasterize_bwd", "splats_reduce", TOTAL)]
    rows = []
    for n in names:
        row = [NAMES.get(n, n)]
        for size in sizes:
            row += columns[size].get(n, ["—", "—", "—"])
        rows.append(row)
    title = "with sums in a fixed order, what differs" if in_order else "ms of the GPU by stage"
    head = [""] + [cell for size in sizes for cell in (f"{size} ms", "floor", "share")]
    notes = []
    if not in_order:
        notes = [_frame_line(findings, size) for size in sizes]
    return "\n".join([f"## {name}: {title}", "", *notes, *_table(head, rows)])


def _frame_line(findings: Findings, size: str) -> str:
    frame, scene = findings.one("frame", size=size), findings.one("scene", size=size)
    if frame is None:
        return ""
    source = scene["source"] if scene else "?"
    return (
        f"{size}: {frame['gaussians']:,} Gaussians of {source}, {frame['width']}×"
        f"{frame['height']}, {frame['seen']:,} visible, {frame['instances']:,} instances, "
        f"{frame['pairs']:,} pairs.\n"
    )


def _floors(
    frame: Finding | None, in_order: bool, bandwidth: Finding | None, rate: Finding | None
) -> dict[str, float]:
    """Milliseconds by native function; from bytes alone if no rate was measured."""
    if frame is None or bandwidth is None:
        return {}
    counts = {key: frame[key] for key in ("gaussians", "seen", "instances", "pairs")}
    known = Frame(**counts, width=frame["width"], height=frame["height"], in_order=in_order)
    a_second = rate["operations_a_second"] if rate else None
    return {
        name: 1e3 * work.seconds(bandwidth["bytes_a_second"], a_second)
        for name, work in works(known).items()
    }


def _column(found: Finding, step: Finding | None, floors: dict[str, float]) -> dict[str, list[str]]:
    """{native function: [time, floor, share]}."""
    times = {name: sum(kernels.values()) for name, kernels in found["kernels"].items()}
    cells = {name: _cells(time, floors.get(name)) for name, time in times.items()}
    if step is not None:
        total = step["plain"]["gpu"]
        cells[REST] = _cells(max(0.0, total - sum(times.values())), None)
        known = sum(floors.values()) if floors else None
        cells[TOTAL] = _cells(total, known)
    return cells


def _cells(time: float, floor: float | None) -> list[str]:
    if floor is None or time <= 0:
        return [f"{time:.3f}", "", ""]
    return [f"{time:.3f}", f"{floor:.3f}", f"{floor / time:.0%}"]


def _steps(findings: Findings, name: str) -> str:
    rows = []
    for size in findings.sizes("step"):
        step = findings.one("step", size=size, in_order=False)
        ordered = findings.one("step", size=size, in_order=True)
        if step is None:
            continue
        memory, frame = findings.one("memory", size=size), findings.one("frame", size=size)
        limit = "GPU" if step["gpu"] >= step["host"] else "CPU"
        cells = [size, *(f"{step[key]:.3f}" for key in ("gpu", "host", "wall")), limit]
        cells += [f"{step['plain'][key]:.3f}" for key in ("host", "wall")]
        cells += [f"{1e3 / step['wall']:.0f}", f"{step['visible']['wall']:.3f}"]
        cells.append(f"{ordered['gpu'] / step['gpu']:.2f}" if ordered else "—")
        if memory and frame:
            peak, count = memory["peak"], frame["gaussians"]
            cells += [
                f"{peak / 1e6:.0f}",
                f"{memory['allocated'] / 1e6:.0f}",
                f"{peak / count:.0f}",
            ]
        else:
            cells += ["—"] * 3
        rows.append(cells)
    if not rows:
        return ""
    head = "size,GPU ms,queueing ms,step ms,limit,queueing without graphs,step without graphs"
    head += ",steps/s,step with visible rows only,in order ×,peak MB,allocated MB"
    lines = [f"## {name}: a training step", "", *_table([*head.split(","), "bytes/Gaussian"], rows)]
    each = _memory_each(findings)
    if each is not None:
        verdict = "within" if each <= MEMORY_GOAL / 1e6 else "NOT within"
        lines += ["", f"1m to 3m: {each:.0f} bytes more per Gaussian, {verdict} the goal of "]
        lines[-1] += f"{MEMORY_GOAL / 1e9:.0f} GB per million on {name}."
    return "\n".join(lines)


def _memory_each(findings: Findings) -> float | None:
    """Bytes per Gaussian: the difference between two scenes at the same image size."""
    found = []
    for size in ("1m", "3m"):
        memory, frame = findings.one("memory", size=size), findings.one("frame", size=size)
        if memory is None or frame is None:
            return None
        found.append((memory["peak"], frame["gaussians"]))
    (less, few), (more, many) = found
    return (more - less) / (many - few)


def _peer(findings: Findings, name: str) -> str:
    none, peer = findings.one("no peer"), findings.one("peer")
    if none is not None:
        return f"## Peer\n\nNot measured: {none['why']}."
    if peer is None:
        return ""
    rows = []
    for found in findings.of_kind("peer times"):
        ratio = found["theirs"] / found["ours"] if found["ours"] > 0 else math.nan
        goal = ""
        if found["what"] == "training step":
            goal = f"goal {PEER_GOAL:.0f}: {'reached' if ratio >= PEER_GOAL else 'NOT reached'}"
        times = [f"{found['ours']:.3f}", f"{found['theirs']:.3f}", f"{ratio:.2f}"]
        rows.append([found["size"], found["what"], *times, goal])
    images = [f"{f['size']}: {f['psnr']:.1f} dB" for f in findings.of_kind("peer image")]
    lines = [f"## {name}: compared with gsplat {peer['version']}", ""]
    if images:
        lines += [f"PSNR between the two images: {', '.join(images)}.", ""]
    return "\n".join(lines + _table(["size", "", "ours ms", "gsplat ms", "ratio", ""], rows))


def _jobs(outcomes: Sequence[Outcome]) -> str:
    lines = ["## What was run", ""]
    done = [f"{o.job} {o.seconds:.0f} s" for o in outcomes if o.state == "done"]
    lines.append(f"Done: {', '.join(done) or 'nothing'}.")
    others = [o for o in outcomes if o.state != "done"]
    reasons = [f"- {o.job}: {o.state} after {o.seconds:.0f} s; {o.reason}"[:240] for o in others]
    return "\n".join(lines + _some(reasons))


def _some(lines: list[str]) -> list[str]:
    """The first of the lines, as a list below a paragraph."""
    if not lines:
        return []
    more = len(lines) - _MOST_LINES
    return ["", *lines[:_MOST_LINES], *([f"- and {more} more"] if more > 0 else [])]


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return lines + ["| " + " | ".join(row) + " |" for row in rows]
