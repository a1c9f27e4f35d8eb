"""Starts Python programs in forks of a process that has loaded all modules: no time for imports.

    python fork_server.py 3 import_all      the server; 3 is its end of a socket, and the function
                                            of imports.py loads the modules

A program has its own streams, environment, handling of Ctrl-C and exit code. If it starts Python
itself, it can fork for that, too. Tests of imports, and of variables that are read by Python or
while libraries are loaded, need a process that is really new.
"""

from __future__ import annotations

import atexit
import functools
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from concurrent.futures import thread as pools
from contextlib import suppress
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_PATHS = filter(None, [str(ROOT / "src"), os.environ.get("PYTHONPATH")])
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(_PATHS)}
_LARGEST_REQUEST = 1 << 17
_MOST_FILES = 4096


def popen(
    *arguments: object,
    env: Mapping[str, str] = ENVIRONMENT,
    stdin: int = subprocess.DEVNULL,
    stdout: int = subprocess.PIPE,
    stderr: int = subprocess.PIPE,
    forks: bool = False,
    group: bool = False,
) -> Process | subprocess.Popen:
    """``python arguments``: ``-m module …``, ``-c code …`` or ``script …``.

    Where forks are not possible, it is a new process.

    Args:
        stdin: or PIPE.
        stdout: or a file descriptor.
        stderr: or STDOUT, or a file descriptor.
        forks: the program starts Python with `subprocess.Popen`; these processes are its forks.
            It must not have computed anything in several threads before.
        group: the program has its own process group, where forks are possible.
    """
    texts = [str(argument) for argument in arguments]
    if hasattr(os, "pidfd_open"):
        request = {"argv": texts, "env": dict(env), "forks": forks, "group": group}
        return Process(_server(), request, stdin, stdout, stderr)
    command = [sys.executable, *texts]
    return subprocess.Popen(command, env=env, stdin=stdin, stdout=stdout, stderr=stderr, text=True)


def run(
    *arguments: object,
    env: Mapping[str, str] = ENVIRONMENT,
    timeout: float = 300,
    forks: bool = False,
) -> subprocess.CompletedProcess[str]:
    """Like `popen`, but waits for the end."""
    process = popen(*arguments, env=env, forks=forks)
    out, err = process.communicate(timeout)
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


class Process:
    """A process that the server started. Its methods are those of `subprocess.Popen`."""

    def __init__(
        self, server: Server | _This, request: dict, stdin: int, stdout: int, stderr: int
    ) -> None:
        self._server = server
        self.args = request["argv"]
        self.returncode: int | None = None
        self.stdin = None
        if stdin == subprocess.PIPE:
            theirs, self.stdin = _pipe("w")
        else:
            theirs = os.open(os.devnull, os.O_RDONLY)
        out, self.stdout = _outward(stdout)
        err, self.stderr = _outward(out if stderr == subprocess.STDOUT else stderr)
        streams = [theirs, out, err]
        self.pid = server.ask({"cwd": os.getcwd()} | request, streams)
        for stream in streams:
            os.close(stream)
        # Until the server is asked for its exit code, the number belongs to this process.
        self._handle = os.pidfd_open(self.pid)

    def poll(self) -> int | None:
        return self._ended_within(0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._ended_within(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(self.args, timeout or 0)
        return code

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        texts = {}

        def read(stream) -> None:
            with stream:
                texts[stream] = stream.read()

        streams = [stream for stream in (self.stdout, self.stderr) if stream]
        threads = [threading.Thread(target=read, args=(s,), daemon=True) for s in streams]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(timeout)
            if thread.is_alive():
                raise subprocess.TimeoutExpired(self.args, timeout or 0)
        self.wait(timeout)
        return texts.get(self.stdout, ""), texts.get(self.stderr, "")

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            signal.pidfd_send_signal(self._handle, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        for stream in (self.stdin, self.stdout, self.stderr):
            if stream:
                stream.close()
        self.wait()

    def _ended_within(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._handle], [], [], timeout)[0]:
            self.returncode = self._server.ask({"ended": self.pid})
            os.close(self._handle)
        return self.returncode


def _pipe(mode: str):
    """The descriptor of the other process, and our end, opened in this mode."""
    read, write = os.pipe()
    theirs, ours = (write, read) if mode == "r" else (read, write)
    return theirs, open(ours, mode, encoding="utf-8")


def _outward(stream: int):
    """The descriptor of the other process for PIPE, DEVNULL or a descriptor, and our end."""
    if stream == subprocess.PIPE:
        return _pipe("r")
    if stream == subprocess.DEVNULL:
        return os.open(os.devnull, os.O_WRONLY), None
    return os.dup(stream), None


class Server:
    """The process that forks, and the socket to it.

    Args:
        load: the function of imports.py that loads the modules.
    """

    def __init__(self, load: str, env: Mapping[str, str] = ENVIRONMENT) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._lock = threading.Lock()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, __file__, str(theirs.fileno()), load],
                env={**env, "OPENBLAS_NUM_THREADS": "1"},  # forks would lack its threads
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # so that the streams of programs are not a terminal's
                pass_fds=[theirs.fileno()],
            )
        atexit.register(self.close)

    def ask(self, request: dict, streams: list[int] | None = None) -> int:
        with self._lock:
            socket.send_fds(self._socket, [json.dumps(request).encode()], streams or [])
            return int(self._socket.recv(_LARGEST_REQUEST))

    def close(self) -> None:
        """End the process."""
        self._socket.close()
        self._process.wait()


class _This:
    """This process, in place of the server: it forks itself."""

    def ask(self, request: dict, streams: list[int] | None = None) -> int:
        if "ended" in request:
            return _exit_code_of(request["ended"])
        pid = os.fork()
        if pid == 0:
            pools._threads_queues.clear()  # a fork has no threads of pools, so none to wait for
            _take(streams or [])
            os.closerange(3, _MOST_FILES)  # among others, the parent's ends of the pipes
            _run_and_exit(request)
        return pid


@functools.cache
def _server() -> Server | _This:
    return Server("import_all")


def _fork_instead_of_start() -> None:
    """From now on, Python programs that this process starts are its forks."""

    def start(command, env=None, stdin=None, stdout=None, stderr=None, **_: object) -> Process:
        assert command[0] == sys.executable
        streams = [
            sys.stdout if stdout is None else stdout,
            sys.stderr if stderr is None else stderr,
        ]
        numbers = [s if isinstance(s, int) else s.fileno() for s in streams]
        environment = dict(os.environ if env is None else env)
        request = {"argv": command[1:], "env": environment, "forks": True, "group": False}
        return Process(_This(), request, stdin or subprocess.DEVNULL, *numbers)

    subprocess.Popen = start


def _take(streams: list[int]) -> None:
    """Make these the standard streams."""
    for number, stream in enumerate(streams):
        os.dup2(stream, number)
        os.close(stream)


def _exit_code_of(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _serve(ours: socket.socket) -> dict:
    """Answer requests; returns only in a fork, with its request."""
    while True:
        data, streams, _, _ = socket.recv_fds(ours, _LARGEST_REQUEST, 3)
        if not data:  # the tests have ended
            os._exit(0)
        request = json.loads(data)
        if "ended" in request:
            ours.send(b"%d" % _exit_code_of(request["ended"]))
            continue
        pid = os.fork()
        if request["group"]:  # in both processes, so that either can rely on it
            with suppress(OSError):  # it has already ended
                os.setpgid(pid, pid)
        if pid == 0:
            ours.close()
            _take(streams)
            return request
        for stream in streams:
            os.close(stream)
        ours.send(b"%d" % pid)


def _execute(request: dict) -> None:
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.clear()
    os.environ.update(request["env"])
    os.chdir(request["cwd"])
    if request["forks"]:
        _fork_instead_of_start()
    first, *rest = request["argv"]
    if first == "-m":
        sys.path[0], sys.argv = os.getcwd(), rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif first == "-c":
        sys.path[0], sys.argv = "", ["-c", *rest[1:]]
        exec(compile(rest[0], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.path[0], sys.argv = str(Path(first).parent), request["argv"]
        runpy.run_path(first, run_name="__main__")


def _exit_code(request: dict) -> int:
    try:
        _execute(request)
    except SystemExit as ended:
        if ended.code is None or isinstance(ended.code, int):
            return ended.code or 0
        print(ended.code, file=sys.stderr)
        return 1
    except BaseException as error:
        sys.excepthook(type(error), error, error.__traceback__)
        return -signal.SIGINT if isinstance(error, KeyboardInterrupt) else 1
    return 0


def _run_and_exit(request: dict) -> None:
    """The end of an interpreter, but it frees no modules: that would take a second."""
    code = 120  # Python's own if the output cannot be written
    try:
        code_of_program = _exit_code(request)
        threading._shutdown()  # waits for threads
        atexit._run_exitfuncs()
        sys.stdout.flush()
        sys.stderr.flush()
        code = code_of_program
        if code < 0:
            signal.signal(-code, signal.SIG_DFL)
            os.kill(os.getpid(), -code)
    finally:
        os._exit(code)


if __name__ == "__main__":
    # Ctrl-C ends the tests, and then the server.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    os.fsync = lambda handle: None  # as in conftest.py
    import imports

    getattr(imports, sys.argv[2])()
    _run_and_exit(_serve(socket.socket(fileno=int(sys.argv[1]))))
