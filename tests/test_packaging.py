"""Installation: the wheel, the source distribution, a machine without a compiler."""

import ast
import hashlib
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
import torch

from snowsplat import __version__
from snowsplat.ops import native
from snowsplat.ops.cuda import nvrtc

REPOSITORY = Path(__file__).resolve().parents[1]
THIRD_PARTY = REPOSITORY / "third_party"
VIEWER_FILES = ("index.html", "index.css", "index.js", "LICENSE")
pytestmark = pytest.mark.build

NO_COMPILER = "snowsplat: no C++ compiler found; install one (Debian/Ubuntu: apt install g++)"


def run(*command: str | Path, **options) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, **options)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    pytest.importorskip("scikit_build_core")
    folder = tmp_path_factory.mktemp("wheel")
    # The build folder of `make native`: nothing is compiled a second time.
    command = [sys.executable, "-m", "pip", "wheel", REPOSITORY, "--no-deps", "--no-index"]
    command += ["--no-build-isolation", "--wheel-dir", folder, "-C", "build-dir=build/native"]
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    if shutil.which("flock"):
        command = ["flock", "build/native.lock", *command]
    result = run(*command, cwd=REPOSITORY, env=os.environ | {"PATH": path})
    assert result.returncode == 0, result.stdout + result.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_one_wheel_for_every_python_of_a_platform(wheel):
    name, version, python, abi, platform = wheel.stem.split("-")
    assert (name, version, python, abi) == ("snowsplat", __version__, "py3", "none")
    assert platform != "any"


def test_wheel_contains_the_libraries_and_all_of_python(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for isa in native.available_isas():
        assert f"snowsplat/_lib/libsnowsplat_{isa}.so" in names
    package = REPOSITORY / "src" / "snowsplat"
    sources = {f"snowsplat/{p.relative_to(package).as_posix()}" for p in package.rglob("*.py")}
    assert sources <= names
    page = {
        f"snowsplat/extras/globe/web/{p.name}"
        for p in (package / "extras" / "globe" / "web").iterdir()
    }
    assert page
    assert page <= names
    assert "snowsplat/py.typed" in names
    assert not any(name.startswith("snowsplat/native/cpu") for name in names)


def test_wheel_contains_gpu_kernels_as_cubins_and_sources(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    native_folder = REPOSITORY / "src" / "snowsplat" / "native"
    sources = [*native_folder.glob("*.h"), *native_folder.glob("cuda/*")]
    assert {f"snowsplat/native/{p.relative_to(native_folder).as_posix()}" for p in sources} <= names
    cubins = {name for name in names if name.startswith("snowsplat/_lib/cuda/")}
    try:
        nvrtc.find((12,))
    except nvrtc.NotFound:
        assert not cubins
        return
    files = [path.stem for path in native_folder.glob("cuda/*.cu")]
    built_for = os.environ.get("SNOWSPLAT_GPU_ARCHITECTURES", "70 75 80 86 89 90 100 120")
    assert cubins == {
        f"snowsplat/_lib/cuda/sm_{number}/{file}.cubin"
        for number in built_for.split()
        for file in files
    }
    assert wheel.stat().st_size < 10e6


def test_source_distribution_contains_all_files_of_a_build(tmp_path):
    build = pytest.importorskip("scikit_build_core.build")
    # A copy without the environment, each of whose files would be compared with .gitignore.
    copy = tmp_path / "checkout"
    ignored = (".venv", ".git", "build", "out", "_lib", "__pycache__", ".*_cache", "node_modules")
    shutil.copytree(REPOSITORY, copy, ignore=shutil.ignore_patterns(*ignored))
    before = os.getcwd()
    os.chdir(copy)
    try:
        name = build.build_sdist(str(tmp_path))
    finally:
        os.chdir(before)
    with tarfile.open(tmp_path / name) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers()}
    needed = ["CMakeLists.txt", "pyproject.toml", "README.md", "src/snowsplat/ops/cuda/nvrtc.py"]
    folders = ("src/snowsplat/native", "third_party")
    needed += [
        path.relative_to(REPOSITORY).as_posix()
        for folder in folders
        for path in (REPOSITORY / folder).rglob("*")
        if path.is_file()
    ]
    assert set(needed) <= names


def test_without_nvrtc_gpu_kernels_are_omitted_with_a_message(tmp_path):
    """Only CMake's configuration runs; nothing is compiled."""
    cmake = shutil.which("cmake", path=f"{Path(sys.executable).parent}{os.pathsep}/usr/bin")
    ninja = shutil.which("ninja", path=f"{Path(sys.executable).parent}{os.pathsep}/usr/bin")
    if cmake is None or ninja is None:
        pytest.skip("needs cmake and ninja (make dev installs them)")
    isolated = tmp_path / "python"
    isolated.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    isolated.chmod(0o755)
    line = "snowsplat: built without GPU kernels; they are compiled when first used"
    command = [cmake, "-G", "Ninja", f"-DCMAKE_MAKE_PROGRAM={ninja}", "-S", REPOSITORY]
    command += ["-B", tmp_path / "build", f"-DPython3_EXECUTABLE={isolated}"]
    result = run(*command, env={k: v for k, v in os.environ.items() if k != "LD_LIBRARY_PATH"})
    assert result.returncode == 0, result.stderr
    if line not in result.stderr.splitlines():
        assert nvrtc_of_the_system()
        return
    rules = (tmp_path / "build" / "build.ninja").read_text()
    assert ".cubin" not in rules
    assert "libsnowsplat_baseline.so" in rules


def nvrtc_of_the_system() -> bool:
    result = run(sys.executable, "-I", "-S", nvrtc.__file__, "--find")
    return result.returncode == 0


def test_wheel_contains_the_viewer_and_its_licence(wheel):
    with zipfile.ZipFile(wheel) as archive:
        files = {name: archive.read(f"snowsplat/_viewer/{name}") for name in VIEWER_FILES}
        assert sum("_viewer/" in name for name in archive.namelist()) == len(files)
        assert not any("third_party" in name for name in archive.namelist())
    with tarfile.open(next(THIRD_PARTY.glob("supersplat-*.tar.xz"))) as vendored:
        for member in vendored.getmembers():
            if member.isfile():
                content = vendored.extractfile(member)
                assert content is not None
                assert files.pop(Path(member.name).name) == content.read()
    assert not files


def test_the_vendored_archive_is_pinned_and_documented():
    (archive,) = THIRD_PARTY.glob("supersplat-*.tar.xz")
    assert archive.stat().st_size < 1.5e6
    assert hashlib.sha256(archive.read_bytes()).hexdigest() in (
        REPOSITORY / "CMakeLists.txt"
    ).read_text(encoding="utf-8")
    assert archive.name in (THIRD_PARTY / "README.md").read_text(encoding="utf-8")
    with tarfile.open(archive) as vendored:
        assert all(not member.name.startswith(("/", "..")) for member in vendored.getmembers())
        assert sorted(Path(m.name).name for m in vendored.getmembers() if m.isfile()) == sorted(
            VIEWER_FILES
        )


def test_a_modified_archive_is_rejected(tmp_path):
    copy = tmp_path / "checkout"
    shutil.copytree(THIRD_PARTY, copy / "third_party")
    shutil.copy(REPOSITORY / "CMakeLists.txt", copy)
    with open(next((copy / "third_party").glob("supersplat-*.tar.xz")), "ab") as file:
        file.write(b"more")
    cmake = shutil.which("cmake", path=f"{Path(sys.executable).parent}{os.pathsep}/usr/bin")
    if cmake is None:
        pytest.skip("needs cmake (make dev installs it)")
    result = run(cmake, "-S", copy, "-B", tmp_path / "build")
    assert result.returncode != 0
    assert "has the wrong checksum" in " ".join(result.stderr.split())


def test_wheel_works_outside_of_the_checkout(wheel, tmp_path):
    zipfile.ZipFile(wheel).extractall(tmp_path)
    code = (
        "import snowsplat; from snowsplat.ops import native; native.set_num_threads(1);"
        "print(snowsplat.__file__, snowsplat.__version__, native.isa())"
    )
    # Without -S, the environment's editable installation of the checkout would be imported.
    clean = {k: v for k, v in os.environ.items() if not k.startswith("SNOWSPLAT_")}
    clean["PYTHONPATH"] = os.pathsep.join(map(str, (tmp_path, Path(torch.__file__).parents[1])))
    result = run(sys.executable, "-S", "-c", code, cwd=tmp_path, env=clean)
    file = tmp_path / "snowsplat" / "__init__.py"
    assert result.stdout.split() == [str(file), __version__, native.available_isas()[-1]]


def test_libraries_depend_only_on_the_c_library():
    if not (readelf := shutil.which("readelf")):
        pytest.skip("needs readelf (apt install binutils)")
    for isa in native.available_isas():
        library = REPOSITORY / "src" / "snowsplat" / "_lib" / f"libsnowsplat_{isa}.so"
        dynamic = run(readelf, "--dynamic", library).stdout.splitlines()
        needed = {line.split("[")[1].rstrip("]") for line in dynamic if "(NEEDED)" in line}
        assert {name.split(".")[0] for name in needed} <= {
            "libc",
            "libm",
            "libpthread",
            "ld-linux-x86-64",
            "ld-linux-aarch64",
        }


@pytest.fixture
def bare_path(tmp_path) -> str:
    """A PATH with the tools of a fresh system and of the environment, but no compiler."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for tool in ("sh", "env", "make", "mkdir", "cmake", "ninja", "uname"):
        beside = Path(sys.executable).parent / tool
        found = beside if beside.exists() else shutil.which(tool)
        if found:
            (folder / tool).symlink_to(found)
    return str(folder)


def test_cmake_without_a_compiler_names_the_package_to_install(tmp_path, bare_path):
    environment = {"PATH": bare_path, "HOME": str(tmp_path)}
    command = ["cmake", "-G", "Ninja", "-S", REPOSITORY, "-B", tmp_path / "build"]
    result = run(f"{bare_path}/cmake", *command[1:], env=environment)
    assert result.returncode != 0
    assert NO_COMPILER in [line.strip() for line in result.stderr.splitlines()]


def test_cmake_with_the_compiler_of_windows_names_clang(tmp_path):
    """CMake takes this one for MSVC, which was not seen itself."""
    compiler, cmake = tmp_path / "cl", Path(sys.executable).parent / "cmake"
    if not cmake.exists() or shutil.which("g++") is None:
        pytest.skip("needs cmake (make dev installs it) and g++")
    looks = "-U__GNUC__ -U__GNUG__ -D_MSC_VER=1930 -D_MSC_FULL_VER=193030000"
    compiler.write_text(f'#!/bin/sh\nexec g++ {looks} "$@"\n')
    compiler.chmod(0o755)
    environment = {**os.environ, "CXX": str(compiler)}
    result = run(cmake, "-S", REPOSITORY, "-B", tmp_path / "build", env=environment)
    assert result.returncode != 0
    assert f"snowsplat: {compiler} cannot build the kernels; install Clang" in result.stderr


def test_make_without_a_compiler_names_the_package_to_install(bare_path):
    command = [f"{bare_path}/make", "--no-print-directory", f"PYTHON={bare_path}/python", "native"]
    result = run(*command, cwd=REPOSITORY, env={"PATH": bare_path})
    assert result.returncode != 0
    assert result.stderr.splitlines()[0] == NO_COMPILER


def test_public_names_can_be_imported():
    import snowsplat
    import snowsplat.data

    for package in (snowsplat, snowsplat.data):  # type checkers see the same names
        tree = ast.parse(Path(package.__file__).read_text(encoding="utf-8"))
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        names = {alias.asname for node in imports for alias in node.names} - {None}
        assert names == set(package.__all__)
    for name in snowsplat._MODULES:
        assert getattr(snowsplat, name).__name__ == name
    assert set(snowsplat.__all__) <= set(dir(snowsplat))
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        _ = snowsplat.nonsense


def test_importing_the_package_does_not_import_torch():
    code = "import sys, snowsplat, snowsplat.data; print('torch' in sys.modules)"
    result = run(
        sys.executable, "-c", code, env=os.environ | {"PYTHONPATH": str(REPOSITORY / "src")}
    )
    assert result.stdout == "False\n"
