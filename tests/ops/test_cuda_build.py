"""GPU kernels compiled by NVRTC for each architecture; no GPU is needed."""

import ast
import functools
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

import snowsplat
from snowsplat.ops.cuda import nvrtc
from snowsplat.ops.cuda.launches import KERNELS, SEQUENCES
from snowsplat.util.native_layout import Layout

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGE = Path(snowsplat.__file__).parent
FILES = sorted(path.stem for path in (PACKAGE / "native" / "cuda").glob("*.cu"))
ARCHITECTURES = re.search(
    r"set\(gpu_architectures ([\d ]+)\)", (REPOSITORY / "CMakeLists.txt").read_text()
)[1].split()

# Bytes of local memory (spilled registers, arrays with dynamic indices) that a thread may have: a
# few registers. Kernels for float64 are for tests, and may have more.
LOCAL_BYTES = {architecture: 24 if architecture == "70" else 16 for architecture in ARCHITECTURES}

pytestmark = pytest.mark.build


@pytest.fixture(scope="module")
def compiler() -> nvrtc.Nvrtc:
    try:
        return nvrtc.Nvrtc(nvrtc.find((12,)))
    except nvrtc.NotFound:
        pytest.skip("needs NVRTC (make dev installs it where it exists)")


def elf_sections(elf: bytes) -> dict[str, bytes]:
    (start,) = struct.unpack_from("<Q", elf, 0x28)
    size, count, names = struct.unpack_from("<HHH", elf, 0x3A)
    # The fields of a section header: name, type, …, offset, size
    headers = [struct.unpack_from("<IIQQQQ", elf, start + i * size) for i in range(count)]

    def text(offset: int) -> str:
        begin = headers[names][4] + offset
        return elf[begin : elf.index(b"\0", begin)].decode()

    nobits = 8
    return {
        text(name): b"" if kind == nobits else elf[offset : offset + length]
        for name, kind, _, _, offset, length in headers
    }


def symbols(table: bytes, names: bytes) -> Iterator[tuple[str, bool]]:
    """Name, and whether it is defined."""
    for name, _, _, section in (row[:4] for row in struct.iter_unpack("<IBBHQQ", table)):
        yield names[name : names.index(b"\0", name)].decode(), section != 0


def attributes(info: bytes) -> Iterator[tuple[int, bytes]]:
    """The attributes of the kernels in a cubin: number and content."""
    at = 0
    while at < len(info):
        form, attribute, size = struct.unpack_from("<BBH", info, at)
        at += 4
        if form == 4:  # else the size is the content
            yield attribute, info[at : at + size]
            at += size


@dataclass
class Built:
    """A kernel in a cubin."""

    threads: int
    parameters: list[int]  # bytes of each
    local_bytes: int


FRAME_SIZE, MAX_THREADS, PARAMETER = 0x11, 0x05, 0x17  # attributes of .nv.info


def kernels_in(cubin: bytes) -> dict[str, Built]:
    sections = elf_sections(cubin)
    names = [name for name, _ in symbols(sections[".symtab"], sections[".strtab"])]
    local = {
        names[symbol]: size
        for attribute, content in attributes(sections[".nv.info"])
        if attribute == FRAME_SIZE
        for symbol, size in [struct.unpack("<II", content)]
    }
    found = {}
    for section, content in sections.items():
        if not section.startswith(".nv.info."):
            continue
        name = section.removeprefix(".nv.info.")
        listed = list(attributes(content))
        (threads,) = (struct.unpack("<III", c)[0] for a, c in listed if a == MAX_THREADS)
        sizes = [struct.unpack("<IHHI", c)[3] >> 18 for a, c in listed if a == PARAMETER]
        found[name] = Built(threads, sizes, local[name])
    return found


def layouts_in(cubin: bytes) -> dict[str, Layout]:
    """The value of the variable NAME_fields of each kernel."""
    sections = elf_sections(cubin)
    names = list(sections)
    found = {}
    for name, _, _, section, value, size in struct.iter_unpack("<IBBHQQ", sections[".symtab"]):
        text = sections[".strtab"][name : sections[".strtab"].index(b"\0", name)].decode()
        if text.endswith("_fields"):
            content = sections[names[section]][value : value + size]
            found[text.removesuffix("_fields")] = Layout(content.partition(b"\0")[0].decode())
    return found


def is_current(built: Path, file: str) -> bool:
    """Whether a file of `make native` matches the sources."""
    made_of = [*nvrtc.sources(nvrtc.path_of(file)), Path(nvrtc.__file__)]
    return built.exists() and built.stat().st_mtime > max(p.stat().st_mtime for p in made_of)


@functools.cache
def compiled(file: str, architecture: str, compiler: nvrtc.Nvrtc) -> tuple[bytes, str]:
    """A new cubin, and the compiler's warnings."""
    return compiler.compile(nvrtc.path_of(file), f"sm_{architecture}")


def cubin_of(file: str, architecture: str, compiler: nvrtc.Nvrtc) -> bytes:
    """The cubin of `make native` if it matches the sources; otherwise a new one."""
    built = PACKAGE / "_lib" / "cuda" / f"sm_{architecture}" / f"{file}.cubin"
    return (
        built.read_bytes() if is_current(built, file) else compiled(file, architecture, compiler)[0]
    )


def warnings_of(file: str, architecture: str, compiler: nvrtc.Nvrtc) -> str:
    """The warnings in `make native` if it had these sources and this compiler; or new ones."""
    log = REPOSITORY / "build" / "native" / "cuda" / f"sm_{architecture}" / f"{file}.cubin.log"
    if is_current(log, file):
        version, _, warnings = log.read_text("utf-8").partition("\n")
        if version == ".".join(map(str, compiler.version)):
            return warnings
    return compiled(file, architecture, compiler)[1]


@pytest.mark.parametrize("file", FILES)
def test_compiles_without_a_warning(file, compiler):
    for architecture in (ARCHITECTURES[0], ARCHITECTURES[-1]):
        assert warnings_of(file, architecture, compiler) == ""
        assert cubin_of(file, architecture, compiler).startswith(b"\x7fELF")


@pytest.mark.parametrize(
    "architecture",
    [
        ARCHITECTURES[0],
        # Continuous integration builds only the oldest and the newest.
        *(pytest.param(each, marks=pytest.mark.nightly) for each in ARCHITECTURES[1:-1]),
        ARCHITECTURES[-1],
    ],
)
@pytest.mark.parametrize("file", FILES)
def test_cubins_contain_all_launched_kernels(file, architecture, compiler):
    expected = {name: kernel for name, kernel in KERNELS.items() if kernel.file == file}
    cubin = cubin_of(file, architecture, compiler)
    found = kernels_in(cubin)
    assert {name.removesuffix("_f64") for name in found} == set(expected)
    for name in expected:
        assert name in found
        if f"{name}_f64" in cpu_entries():
            assert f"{name}_f64" in found
    for name, built in found.items():
        kernel = expected[name.removesuffix("_f64")]
        assert built.threads == kernel.threads
        assert built.parameters == [layouts_in(cubin)[name].size], "one struct, by value"
        if not name.endswith("_f64"):
            assert built.local_bytes <= LOCAL_BYTES[architecture], name


def cpu_entries() -> set[str]:
    """The functions of the CPU's library."""
    sections = elf_sections((PACKAGE / "_lib" / "libsnowsplat_baseline.so").read_bytes())
    return {name for name, here in symbols(sections[".dynsym"], sections[".dynstr"]) if here}


def called(names: tuple[str, ...]) -> set[str]:
    """First string arguments of calls of these functions in the ops."""
    found = set()
    for path in (PACKAGE / "ops").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                function = node.func
                name = function.id if isinstance(function, ast.Name) else None
                if name in names:
                    found.add(node.args[0].value)
    return found


def test_every_function_is_on_both_kinds_of_device():
    launched = called(("launch", "variant", "query_size"))
    assert {"project_cull", "rasterize_fwd", "adam_step", "tiles_parts", "neighbours"} <= launched
    on_gpu = set(KERNELS) | set(SEQUENCES)
    assert launched - on_gpu == set()
    # The backward pass on a CPU sums the gradients of a splat itself.
    assert launched - cpu_entries() == {"splats_reduce"}
    entries = {name.removesuffix("_fields") for name in cpu_entries() if name.endswith("_fields")}
    assert entries <= cpu_entries()
    with_arrays = {"detect_sift", "match_descriptors", "align_patches", "resample"}
    assert {name.removesuffix("_f64") for name in entries} - with_arrays <= on_gpu


STATISTIC_SOURCES = [
    "statistic.cu",
    "device.h",
    "statistic.h",
    "params.h",
    "layout.h",
    "portable.h",
]


def test_a_compile_error_has_the_message_and_the_line(compiler, tmp_path):
    source = tmp_path / "wrong.cu"
    source.write_text(
        '#include "cuda/device.h"\nSNOW_KERNEL(wrong, 32, snow::SizeQueryParams) { nonsense(); }\n'
    )
    with pytest.raises(nvrtc.CompileError, match=r"wrong.cu does not compile for sm_90: (.|\n)*"):
        compiler.compile(source, "sm_90")
    script = [sys.executable, nvrtc.__file__, source, "--target", "sm_90"]
    result = subprocess.run(
        [*script, "--output", tmp_path / "wrong.cubin"], capture_output=True, text=True
    )
    assert result.returncode == 1
    assert 'wrong.cu(2): error: identifier "nonsense" is undefined' in result.stderr
    assert not (tmp_path / "wrong.cubin").exists()


def test_the_script_needs_only_python(compiler, tmp_path):
    """As in the build of a wheel, neither torch nor snowsplat can be imported."""
    source, cubin = nvrtc.path_of("statistic"), tmp_path / "in a folder" / "statistic.cubin"
    library = nvrtc.find((12,))
    script = [sys.executable, "-I", "-S", nvrtc.__file__, source, "--target", "sm_86"]
    script += ["--output", cubin, "--depfile", f"{cubin}.d", "--log", f"{cubin}.log"]
    script += ["--library", library, "--lineinfo"]
    result = subprocess.run(script, capture_output=True, text=True)
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")
    assert "accumulate_screen_statistics_f64" in kernels_in(cubin.read_bytes())
    assert b".debug_line" in cubin.read_bytes()
    assert Path(f"{cubin}.log").read_text() == ".".join(map(str, compiler.version)) + "\n"
    target, *names = Path(f"{cubin}.d").read_text().replace(r"\ ", "?").split()
    assert target == f"{cubin}:".replace(" ", "?")
    assert [Path(name).name for name in names] == STATISTIC_SOURCES
    # The code is reproducible, and has no paths of this machine.
    once, again = (compiler.compile(source, "sm_86")[0] for _ in range(2))
    assert once == again
    assert str(REPOSITORY).encode() not in once


def test_without_nvrtc_there_is_a_message():
    script = [sys.executable, "-I", "-S", nvrtc.__file__, "--find"]
    result = subprocess.run(script, capture_output=True, text=True, env={})
    if result.returncode == 0:
        pytest.skip("the loader finds an NVRTC of the system")
    assert (result.returncode, result.stdout, result.stderr) == (1, "", "NVRTC is not installed\n")
