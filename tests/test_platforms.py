"""Windows and macOS: calls that only POSIX systems have, and the import of all modules without them."""

import ast
import functools
import subprocess
import sys
from pathlib import Path

import vehicle_detection
from tests.helpers import ROOT

FOLDER = Path(vehicle_detection.__file__).parent

POSIX_ONLY = {
    "os": {
        "O_CLOEXEC", "O_DIRECTORY", "O_NOFOLLOW", "O_NONBLOCK", "WNOHANG", "chown", "chroot",
        "fork", "forkpty", "getegid", "geteuid", "getgid", "getloadavg", "getpgid", "getuid",
        "killpg", "lchown", "mkfifo", "mknod", "nice", "openpty", "posix_spawn", "pread", "pwrite",
        "register_at_fork", "sched_getaffinity", "sched_setaffinity", "setpgid", "setpgrp",
        "setsid", "statvfs", "sysconf", "uname", "wait3", "wait4", "waitid",
    },
    "signal": {
        "SIGALRM", "SIGCHLD", "SIGCONT", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGQUIT", "SIGSTOP",
        "SIGUSR1", "SIGUSR2", "alarm", "getitimer", "pause", "pthread_kill", "pthread_sigmask", "setitimer",
        "sigwait",
    },
}  # fmt: skip
"""Names of modules of the standard library that Windows does not have."""

POSIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}

GUARDED = {
    ("_common.files", "open_locked", "fcntl"): "called unless sys.platform is win32",
    ("_common.files", "open_locked", "os.O_CLOEXEC"): "called unless sys.platform is win32",
    ("_common.files", "open_locked", "os.O_NOFOLLOW"): "called unless sys.platform is win32",
    ("_common.threads", "available_cores", "os.sched_getaffinity"): "hasattr; macOS does not have it, either",
    ("_common.signals", "_repeat", "signal.pthread_kill"): "hasattr",
    ("_common.threads", "", "os.register_at_fork"): "hasattr",
    ("network.model", "", "os.register_at_fork"): "hasattr",
    ("drive.worker_pool", "_prepare", "os.setpgid"): "hasattr",
    ("drive.worker_pool", "_watch", "signal.pthread_kill"): "hasattr",
    ("_common.files", "private_folder", "os.getuid"): "hasattr",
    ("video.ffmpeg", "", "os.register_at_fork"): "hasattr",
    ("video.ffmpeg", "_enlarge", "fcntl"): "on Linux only",
    ("video.ffmpeg", "_is_memory_limited", "resource"): "ImportError is caught",
    ("video.ffmpeg", "_poll", "os.WNOHANG"): "wait returns before on win32",
    ("video.ffmpeg", "_poll", "os.wait4"): "wait returns before on win32",
}
"""Uses of what only POSIX has, by module, function and name, and why they do no harm elsewhere."""


@functools.cache
def modules():
    paths = {".".join(path.relative_to(FOLDER).with_suffix("").parts): path for path in FOLDER.rglob("*.py")}
    return {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in paths.items()}


def posix_uses():
    """Yield module, function and name of each use of what only POSIX has."""
    for name, tree in modules().items():
        yield from ((name, function, found) for function, found in _uses(tree, ""))


def _uses(node, function):
    for child in ast.iter_child_nodes(node):
        inner = child.name if isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)) else function
        if isinstance(child, ast.Import):
            yield from ((inner, alias.name) for alias in child.names if alias.name in POSIX_MODULES)
        elif isinstance(child, ast.ImportFrom) and child.module in POSIX_MODULES:
            yield inner, child.module
        elif isinstance(child, ast.Attribute) and child.attr in POSIX_ONLY.get(ast.unparse(child.value), ()):
            yield inner, ast.unparse(child)
        yield from _uses(child, inner)


def test_what_only_posix_has_is_guarded():
    assert set(posix_uses()) == set(GUARDED), "add the reason, or an alternative for Windows"


# Modules that need the extra train, which may be missing here.
TORCH_MODULES = ("architecture", "export", "fine_tune", "loss", "network", "samples", "weights")

# Import the libraries first, which need the real platform; then all modules of this one, as on Windows.
AS_ON_WINDOWS = f"""
import builtins, importlib, os, pkgutil, signal, subprocess, sys, tempfile
from pathlib import Path
import vehicle_detection, matplotlib.pyplot, pandas, typer.testing

def names():
    found = pkgutil.walk_packages(vehicle_detection.__path__, "vehicle_detection.")
    skipped = [f"vehicle_detection.training.{{name}}" for name in {TORCH_MODULES!r}]
    return [each.name for each in found if not each.name.endswith(".__main__") and each.name not in skipped]

for name in names():
    importlib.import_module(name)
for name in [name for name in sys.modules if name.startswith("vehicle_detection")]:
    del sys.modules[name]
real_import = builtins.__import__

def refuse(name, *args, **kwargs):
    caller = (args[0] or {{}}).get("__name__", "") if args else ""
    if name in {POSIX_MODULES!r} and caller.startswith("vehicle_detection"):
        raise ImportError(f"no module named {{name}}")
    return real_import(name, *args, **kwargs)

builtins.__import__ = refuse
sys.platform, signal.SIGBREAK = "win32", 10
subprocess.CREATE_NEW_PROCESS_GROUP = 0
used = ("getuid", "geteuid", "SIGCHLD", "WNOHANG", "O_NONBLOCK")  # by the standard library here
for module, missing in {POSIX_ONLY!r}.items():
    for name in missing:
        if hasattr(sys.modules[module], name) and name not in used:
            delattr(sys.modules[module], name)
import vehicle_detection
print(len([importlib.import_module(name) for name in names()]))

from vehicle_detection._common import atomic_write, available_cores, temporary_folder
from vehicle_detection.drive.batch_store import open_store
from vehicle_detection.cli.signals import raise_on_signals

folder = Path(tempfile.mkdtemp())
with atomic_write(folder / "a.csv") as part, temporary_folder(folder, "b") as inner:
    part.write_text("whole")
    (inner / "c").touch()
with open_store(folder).lock("a") as free, raise_on_signals():
    handled = callable(signal.getsignal(signal.SIGBREAK))
    print(free, handled, available_cores() > 0, sorted(path.name for path in folder.iterdir()))
"""


def test_all_modules_work_without_what_only_posix_has():
    done = subprocess.run(
        [sys.executable, "-c", AS_ON_WINDOWS], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    count, rest = done.stdout.splitlines()
    assert int(count) > 100
    assert rest == "True True True ['a.csv']"


def test_text_files_have_the_same_line_breaks_everywhere():
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
                named = {keyword.arg for keyword in node.keywords}
                is_own = isinstance(node.func.value, ast.Name) and node.func.value.id == "common"
                is_set = node.func.attr != "write_text" or "newline" in named
                assert is_own or is_set, f"{name} {node.lineno}"
