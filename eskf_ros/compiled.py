"""The one decorator for compiled functions, and where their machine code is cached.

The kernels are plain Python that numba compiles. Without numba, or with ``NUMBA_DISABLE_JIT=1``, the same code
runs uncompiled and keeps up with an IMU of about 100 Hz.

numba notices a changed source file only for the function it compiles, not for what that function calls in other
files. The cache folder therefore carries a digest of all files with kernels and of what they import: a new version
never runs old code.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import math
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

try:
    import numba
except ImportError:
    numba = None

COMPILED: bool = numba is not None and not numba.config.DISABLE_JIT
"""True when the kernels run as machine code."""

PROGRESS_PERIOD = 5.0
"""Seconds from one sentence about compiling to the next."""

USUAL_COUNT = 500
"""Functions, each type of arguments counted, that a first start compiles, about: for the estimate of progress only."""

_KEPT_CACHES = 4

_IMPORT = re.compile(rb"^from eskf_ros\.([\w.]+) import", re.MULTILINE)
"""An import within the package, in the one form it has here but for ``from eskf_ros import MODULE``."""


def _sources_digest(package: Path) -> str:
    """Return a digest of the files with kernels and of all that they import from ``package``, however indirectly.

    numba freezes the constants that a kernel takes from other files into its machine code.
    """
    texts = {source: source.read_bytes() for source in package.rglob("*.py")}
    found: set[Path] = set()
    waiting = [source for source, text in texts.items() if b"@njit" in text]
    while waiting:
        source = waiting.pop()
        if source in found:
            continue
        found.add(source)
        for name in _IMPORT.findall(texts[source]):
            imported = package.joinpath(*name.decode().split("."))
            waiting += [imported.with_suffix(".py")] if imported.with_suffix(".py") in texts else imported.glob("*.py")
    digest = hashlib.sha256()
    for source in sorted(found):
        digest.update(source.relative_to(package).as_posix().encode())
        digest.update(texts[source])
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a writable folder for this version's machine code, in the user's cache or else in the temporary folder."""
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for parent in (user_cache / "eskf_ros", Path(tempfile.gettempdir()) / f"eskf_ros_{os.getuid()}"):
        folder = parent / _sources_digest(Path(__file__).parent)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            continue
        _prune(parent)
        return folder
    return Path(tempfile.mkdtemp(prefix="eskf_ros_"))


def _prune(parent: Path) -> None:
    """Remove the machine code of old versions, keeping the newest few (several checkouts may be in use)."""
    folders = sorted((f for f in parent.iterdir() if f.is_dir()), key=lambda f: f.stat().st_mtime, reverse=True)
    for folder in folders[_KEPT_CACHES:]:
        shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def while_compiling(tell: Callable[[int], None]) -> Iterator[None]:
    """While this lasts, call ``tell`` after each function that was compiled, with their number so far.

    What comes from the cache does not count.
    """
    if not COMPILED:
        yield
        return
    from numba.core import event

    counts = itertools.count(1)

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, started: Any) -> None:
            pass

        def on_end(self, ended: Any) -> None:
            tell(next(counts))

    with event.install_listener("numba:compile", Listener()):
        yield


def sentence_on_compiling(say: Callable[[str], None]) -> Callable[[int], None]:
    """Return what `while_compiling` calls, which calls ``say`` with a sentence at once and then every few seconds."""
    started, told = time.monotonic(), -math.inf

    def tell(count: int) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > PROGRESS_PERIOD:
            told = now
            share = min(99, 100 * count // USUAL_COUNT)
            say(
                f"compiling the estimator: {count} functions in {now - started:.0f} s, about {share} % "
                "(only the first start after an installation)"
            )

    return tell


def _with_few_types(dispatcher: Any) -> Any:
    """Make kernels that call this one agree on its argument types; returns the dispatcher.

    numba compiles a function anew for each constant argument, each enumeration and each width of integer. These differ
    in nothing that a kernel does, so that the compiled functions are fewer by a tenth.
    """
    from numba.core import types

    def common(kind: Any) -> Any:
        kind = types.unliteral(kind)
        if isinstance(kind, types.IntEnumMember) or (isinstance(kind, types.Integer) and kind.signed):
            return types.int64
        return kind

    template_of = dispatcher.get_call_template
    dispatcher.get_call_template = lambda args, kws: template_of(
        tuple(map(common, args)), {name: common(kind) for name, kind in kws.items()}
    )
    return dispatcher


if COMPILED:
    CACHE_FOLDER: Path | None = None if numba.config.CACHE_DIR else _cache_folder()

    def _compiled(function: Function, **options: Any) -> Function:
        previous = numba.config.CACHE_DIR
        if CACHE_FOLDER is not None:
            numba.config.CACHE_DIR = str(CACHE_FOLDER)
        try:
            # No fast math: fused operations round differently wherever the compiler inlines differently, and two
            # processes would no longer agree to the bit.
            dispatcher: Function = _with_few_types(numba.njit(cache=True, error_model="numpy", **options)(function))
            return dispatcher
        finally:
            numba.config.CACHE_DIR = previous

    def njit(function: Function) -> Function:
        """Compile ``function`` on first use and cache the machine code (``NUMBA_CACHE_DIR`` is respected)."""
        return _compiled(function)

    def njit_in_caller(function: Function) -> Function:
        """As `njit`, for a large function with one caller: it becomes a part of that one.

        numba makes machine code of every function with all that it calls in it, so that each storey of a tall tree of
        calls is compiled as often as there are storeys above it.
        """
        return _compiled(function, inline="always")

else:
    CACHE_FOLDER = None

    def njit(function: Function) -> Function:
        """Return ``function`` unchanged: numba is missing or switched off."""
        return function

    njit_in_caller = njit
