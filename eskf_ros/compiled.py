"""The decorators of compiled functions, and where their machine code is kept.

The kernels are plain Python that numba compiles. Without numba, or with ``NUMBA_DISABLE_JIT=1``, the same code
runs uncompiled and keeps up with an IMU of about 100 Hz.

The machine code of a module lies in a folder that carries a digest of this module and of all that it imports from the
package: numba by itself notices a changed file only for the function that it compiles, not for what that function calls
or which constants it takes from other files. So a new version never runs old code, and an edit costs the compiling of
the modules that depend on it. The folder does not depend on where the package lies: what a build has compiled
(`setup.py`, in ``eskf_ros/machine_code``) is copied to the cache of the user, where numba finds it if the processor is
the same.
"""

from __future__ import annotations

import contextlib
import copy
import gc
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
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])

try:
    import numba
except ImportError:
    numba = None

COMPILED: bool = numba is not None and not numba.config.DISABLE_JIT
"""True when the kernels run as machine code."""

PROGRESS_PERIOD = 5.0
"""Seconds from one sentence about compiling to the next."""

USUAL_COUNT = 488
"""Functions, each type of arguments counted, that a first start compiles, about: for the estimate of progress only."""

OPTIMISATION = 1
"""LLVM's level of optimisation. The third costs a fifth more time of the first start and of its memory; these kernels
are not faster by it (no large loops, no calls that are not inlined anyway)."""

COLLECTION = (20_000, 20, 20)
"""Thresholds of Python's garbage collector while it compiles: numba makes many objects that stay."""

KEPT_VERSIONS = 4
"""Versions of the machine code of one module that are kept; several checkouts may be in use."""

BUILT = Path(__file__).parent / "machine_code"
"""Machine code that was made when the package was built; not there in a checkout."""

_IMPORT = re.compile(r"^from eskf_ros\.([\w.]+) import (\([^)]*\)|[^\n(]+)", re.MULTILINE)
"""An import within the package, in the one form it has here."""

_NAME = re.compile(r"\w+")


class Digests:
    """Digests of the modules of a package, each with all that it imports from there, however indirectly."""

    def __init__(self, package: Path) -> None:
        self._package = package
        self._needed: dict[str, frozenset[str]] = {}
        self._texts: dict[str, str] = {}

    def _exists(self, module: str) -> bool:
        return self._package.joinpath(*module.split(".")).with_suffix(".py").is_file()

    def _imports(self, module: str) -> set[str]:
        """Modules that a module imports itself."""
        text = self._package.joinpath(*module.split(".")).with_suffix(".py").read_text(encoding="utf-8")
        self._texts[module] = text
        found = set()
        for source, names in _IMPORT.findall(text):
            if self._exists(source):
                found.add(source)
            found |= {f"{source}.{name}" for name in _NAME.findall(names) if self._exists(f"{source}.{name}")}
        return found

    def needed(self, module: str) -> frozenset[str]:
        """The module and all that it needs."""
        if module not in self._needed:
            found: set[str] = set()
            waiting = [module]
            while waiting:
                name = waiting.pop()
                if name in self._needed:
                    found |= self._needed[name]
                elif name not in found:
                    found.add(name)
                    waiting += self._imports(name)
            self._needed[module] = frozenset(found)
        return self._needed[module]

    def of_all(self) -> str:
        """Digest of all modules of the package."""
        sources = sorted(self._package.rglob("*.py"))
        return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:16]

    def of(self, module: str) -> str:
        """Digest of a module (name below the package)."""
        digest = hashlib.sha256()
        for name in sorted(self.needed(module)):
            digest.update(name.encode())
            digest.update(self._texts[name].encode())
        return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """Return a writable folder for machine code: in the user's cache, or else in the temporary folder."""
    user_cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    for folder in (user_cache / "eskf_ros", Path(tempfile.gettempdir()) / f"eskf_ros_{os.getuid()}"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            continue
        return folder
    return Path(tempfile.mkdtemp(prefix="eskf_ros_"))


def _folder_of(module: str, digest: str) -> Path:
    """Return the folder for the machine code of a module, with what the build has made in it."""
    assert CACHE_FOLDER is not None
    folder = CACHE_FOLDER / f"{module}.{digest}"
    if not folder.is_dir():
        _prune(module)
        built = BUILT / folder.name
        if built.is_dir() and built != folder:
            # Under another name first: two processes may start at the same time.
            CACHE_FOLDER.mkdir(parents=True, exist_ok=True)
            new = Path(tempfile.mkdtemp(dir=CACHE_FOLDER, prefix=".new_"))
            shutil.copytree(built, new, dirs_exist_ok=True)
            try:
                new.rename(folder)
            except OSError:
                shutil.rmtree(new, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
    return folder


def _prune(module: str) -> None:
    """Remove the machine code of old versions of a module."""
    assert CACHE_FOLDER is not None
    folders = [f for f in CACHE_FOLDER.glob(f"{module}.*") if f.name.rpartition(".")[0] == module]
    folders.sort(key=_changed, reverse=True)
    for folder in folders[KEPT_VERSIONS - 1 :]:
        shutil.rmtree(folder, ignore_errors=True)


def _changed(folder: Path) -> float:
    """Return when a folder was last changed (s); long ago if another process, that starts, too, has removed it."""
    try:
        return folder.stat().st_mtime
    except FileNotFoundError:
        return 0.0


@contextlib.contextmanager
def while_compiling(tell: Callable[[int], None]) -> Iterator[Callable[[], float]]:
    """While this lasts, call ``tell`` after each function that was compiled, with their number so far.

    What comes from the cache does not count. Gives a function that returns the seconds of compiling so far.
    """
    seconds = 0.0
    if not COMPILED:
        yield lambda: seconds
        return
    from numba.core import event

    counts = itertools.count(1)
    under_way: list[float] = []  # a function that is compiled may call for others

    class Listener(event.Listener):  # type: ignore[misc]
        def on_start(self, started: Any) -> None:
            under_way.append(time.monotonic())

        def on_end(self, ended: Any) -> None:
            nonlocal seconds
            began = under_way.pop()
            if not under_way:
                seconds += time.monotonic() - began
            tell(next(counts))

    with event.install_listener("numba:compile", Listener()):
        yield lambda: seconds


def sentence_on_compiling(say: Callable[[str], None]) -> Callable[[int], None]:
    """Return what `while_compiling` calls, which calls ``say`` with a sentence at once and then every few seconds."""
    started, told = time.monotonic(), -math.inf

    def tell(count: int) -> None:
        nonlocal told
        now = time.monotonic()
        if now - told > PROGRESS_PERIOD:
            told = now
            say(
                f"compiling the estimator: {count} of about {max(count, USUAL_COUNT)} functions "
                f"in {now - started:.0f} s (only the first start after an installation)"
            )

    return tell


class _CopyWithOneScope:
    """Takes the place of the module ``copy`` where numba puts one function into another (`njit_in_caller`).

    numba 0.58, that of Ubuntu 24.04, copies the statements of such a function one by one, each with the table of all
    variables: half of the first start. Here the statements of a block share one table, as in newer versions.
    """

    def __init__(self) -> None:
        self._scope_of_block: dict[int, Any] = {}

    def deepcopy(self, original: Any) -> Any:
        from numba.core import ir

        if not isinstance(original, ir.Block):
            return copy.deepcopy(original, dict(self._scope_of_block))
        copied = copy.deepcopy(original)
        self._scope_of_block = {id(original.scope): copied.scope}
        return copied


@contextlib.contextmanager
def _frugally() -> Iterator[None]:
    """Compile within this with less time and memory than numba by itself; other kernels of the process as they were."""
    from numba.core import inline_closurecall
    from numba.core import types as numba_types

    inlining, record = cast(Any, inline_closurecall), cast(Any, numba_types.Record)
    level, thresholds, description = numba.config.OPT, gc.get_threshold(), record.__repr__
    copying, inlining.copy = inlining.copy, _CopyWithOneScope()
    numba.config.OPT = type(level)(min(level, OPTIMISATION))
    gc.set_threshold(*COLLECTION)
    # numba describes the arguments to itself before each of its passes, which takes seconds for records in records.
    record.__repr__ = numba_types.Type.__repr__
    try:
        yield
    finally:
        inlining.copy = copying
        numba.config.OPT = level
        gc.set_threshold(*thresholds)
        record.__repr__ = description


def _compiling_frugally(dispatcher: Any) -> Any:
    """Make a dispatcher compile so; returns it."""
    compile_one = dispatcher.compile

    def compile_signature(signature: Any) -> Any:
        with _frugally():
            return compile_one(signature)

    dispatcher.compile = compile_signature
    return dispatcher


def _with_few_types(dispatcher: Any) -> Any:
    """Make kernels that call this one agree on its argument types; returns the dispatcher.

    numba compiles a function anew for each constant argument, each enumeration and each width of integer. These differ
    in nothing that a kernel does, so that the compiled functions are fewer by a tenth.
    """
    from numba.core import types as numba_types

    types: Any = numba_types

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
    from numba.core import caching

    CACHE_FOLDER: Path | None = Path(numba.config.CACHE_DIR) if numba.config.CACHE_DIR else _cache_folder()
    _DIGESTS = Digests(Path(__file__).parent)

    class _Locator(caching._CacheLocator):  # type: ignore[misc]
        """Tells numba where the machine code of a function of this package is."""

        def __init__(self, function: Callable[..., Any], file: str) -> None:
            package, _, module = function.__module__.partition(".")
            self._line = function.__code__.co_firstlineno
            if package == "eskf_ros" and module:
                self._stamp = ""  # The name of the folder says which source it is.
                self._folder = _folder_of(module, _DIGESTS.of(module))
            else:
                # A kernel of a test or of somebody else, which may call any of ours.
                self._stamp = f"{os.stat(file).st_mtime_ns} {_DIGESTS.of_all()}"
                self._folder = _folder_of(function.__module__, "outside")

        @classmethod
        def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
            return cls(py_func, py_file)

        def get_cache_path(self) -> str:
            return str(self._folder)

        def get_source_stamp(self) -> str:
            return self._stamp

        def get_disambiguator(self) -> str:
            return str(self._line)

    class _Implementation(caching.CompileResultCacheImpl):  # type: ignore[misc]
        _locator_classes = (_Locator,)

    class _Cache(caching.FunctionCache):  # type: ignore[misc]
        _impl_class = _Implementation

    def _compiled(function: Function, **options: Any) -> Function:
        # No fast math: fused operations round differently wherever the compiler inlines differently, and two
        # processes would no longer agree to the bit.
        # Nobody calls a kernel from C, so that it needs no wrapper for that.
        dispatcher = numba.njit(error_model="numpy", no_cfunc_wrapper=True, **options)(function)
        dispatcher._cache = _Cache(function)
        compiled: Function = _with_few_types(_compiling_frugally(dispatcher))
        return compiled

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
