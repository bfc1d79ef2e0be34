"""Machine code is kept only while every compiled source is as it was.

Numba keeps what it compiled beside the sources. Before it takes that again it looks whether the
function's own file has changed, not whether another has whose functions were compiled into it
(numba issue 1833). The correction of a setpoint has the statics in it, and those the placing of
frames: after an update of the one, the other would go on as before, and say nothing.

This replaces private parts of numba (``PRIVATE``). Where a numba has them no more, nothing is kept:
each process compiles what it calls.
"""

from __future__ import annotations

import hashlib
import sys
from functools import cache
from pathlib import Path
from typing import Any, cast

from llvmlite import binding  # type: ignore[import-untyped]
from numba import config
from numba.core import caching, codegen, compiler, dispatcher, environment, event
from numba.core.runtime import nrtdynmod
from numba.core.runtime.nrt import rtsys

from gapbridge.core.kernels import compiling

CORE = Path(__file__).resolve().parents[1]
FOLDERS = (CORE, CORE / "kernels")  # where compiled functions are that others have inside them
OURS = tuple(CORE.parent / name for name in ("core", "drivers", "bridge"))
MARK = b"njit"
PRIVATE: tuple[tuple[Any, str], ...] = (
    (config, "CACHE_LOCATOR_CLASSES"), (dispatcher, "FunctionCache"),
    (caching.Cache, "_load_overload"),
    (codegen.JITCodeLibrary, "_get_module_for_linking"),
    (codegen.JITCodeLibrary, "_set_compiled_object"),
    (codegen.JITCodeLibrary, "_finalize_final_module"),
    (compiler, "compile_result"), (nrtdynmod, "compile_nrt_functions"),
    (nrtdynmod, "create_nrt_module"), (environment, "_rebuild_env"),
    (environment, "lookup_environment"), (environment.Environment, "_memo"),
)  # fmt: skip
USUAL = ("UserProvided", "InTree", "UserWide", "IPython", "Zip")


@cache
def fingerprint() -> bytes:
    """Return a hash of all sources with compiled functions that others may have inside them."""
    found = hashlib.sha256()
    for file, source in _compiled():
        found.update(b"%s %d " % (file.name.encode(), len(source)) + source)
    return found.digest()


@cache
def names() -> str:
    """Return a short hash of the compiled modules' names, for the names of their machine code.

    Numba's index of a function is pickled with the classes of its arguments: an index that was
    written before a module was renamed cannot even be read.
    """
    found = " ".join(file.relative_to(CORE).as_posix() for file, _ in _compiled())
    return hashlib.sha256(found.encode()).hexdigest()[:8]


@cache
def _compiled() -> list[tuple[Path, bytes]]:
    files = sorted(file for folder in FOLDERS for file in folder.glob("*.py"))
    sources = [(file, file.read_bytes()) for file in files]
    return [(file, source) for file, source in sources if MARK in source]


@cache
def _is_ours(file: str) -> bool:
    return any(folder in Path(file).resolve().parents for folder in OURS)


_WRITABLE: set[str] = set()  # folders in which a file could be made


class _OfAllSources:
    """Finds a place for machine code of our functions, and none for anybody else's."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        if not _is_ours(py_file):
            return None
        return super().from_function(py_func, py_file)  # type: ignore[misc]

    def ensure_cache_path(self) -> None:
        """Try once for each folder, not for each function, whether files can be made in it."""
        path = self.get_cache_path()  # type: ignore[attr-defined]
        if path not in _WRITABLE:
            super().ensure_cache_path()  # type: ignore[misc]
            _WRITABLE.add(path)

    def get_source_stamp(self) -> tuple[Any, bytes]:
        return super().get_source_stamp(), fingerprint()  # type: ignore[misc]

    def get_disambiguator(self) -> str:
        return f"{super().get_disambiguator()}-{names()}"  # type: ignore[misc]


class UserProvided(_OfAllSources, caching.UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class InTree(_OfAllSources, caching.InTreeCacheLocator):
    """Beside the source."""


class UserWide(_OfAllSources, caching.UserWideCacheLocator):
    """In the user's own cache, where the sources' folder cannot be written to."""


class _Library(codegen.JITCodeLibrary):
    """Machine code that was loaded, its bitcode left unread until something is linked with it.

    Reading it takes longer than loading the machine code, and a process that compiles nothing
    needs no more of it than which symbols it defines.
    """

    _bitcode = b""

    @classmethod
    def loaded(cls, generator: Any, kept: tuple[set[str], tuple[str, str, Any]]) -> _Library:
        symbols, (name, _, (code, bitcode)) = kept
        self: Any = cls(generator, name)
        self._bitcode = bitcode
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._finalize_final_module()
        generator._engine._defined_symbols |= symbols
        return cast(_Library, self)

    def _get_module_for_linking(self) -> Any:
        if self._shared_module is None:
            self._shared_module = binding.parse_bitcode(self._bitcode)
        return super()._get_module_for_linking()  # type: ignore[no-untyped-call]


def _symbols(library: Any) -> set[str]:
    """Return the names of what a library defines."""
    module = library._get_module_for_linking()
    named = [*module.functions, *module.global_variables]
    return {value.name for value in named if not value.is_declaration}


class _Result(caching.CompileResultCacheImpl):
    """How a compiled function becomes a file, and again a function."""

    def reduce(self, cres: Any) -> Any:
        kept, *rest = super().reduce(cres)  # type: ignore[no-untyped-call]
        return (_symbols(cres.library), kept), rest

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        kept, (fndesc, env, signature, objectmode, lifted, annotation, reload, envs) = payload
        for begin in reload:
            begin()
        generator = target_context.codegen()
        library = _Library.loaded(generator, kept)
        entry_point = target_context.get_executable(library, fndesc, env)
        for one in envs:
            generator.set_env(one.env_name, one)
        return compiler.compile_result(  # type: ignore[no-untyped-call]
            typing_context=target_context.typing_context, target_context=target_context,
            entry_point=entry_point, type_annotation=annotation, signature=signature,
            objectmode=objectmode, lifted=lifted, fndesc=fndesc, library=library, environment=env,
            reload_init=reload, referenced_envs=envs,
        )  # fmt: skip


class Kept(caching.FunctionCache):
    """The machine code of one of our functions, kept from process to process."""

    _impl_class = _Result

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the machine code for a signature, or None where there is none.

        Numba first makes itself ready to compile (and imports scipy.linalg for that): 0.3 s in
        each process. What is only loaded needs the functions that count references alone; what
        then has to be compiled makes itself ready by itself.
        """
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]


def _cache_of(function: Any) -> Any:
    """Return what keeps the machine code of a function: of others' functions what numba has."""
    ours = _is_ours(function.__code__.co_filename)
    return (Kept if ours else caching.FunctionCache)(function)  # type: ignore[no-untyped-call]


class _Counting(caching.CodeLibraryCacheImpl):
    """How the functions that count references become a file."""

    _filename_prefix: Any = "nrt"

    def reduce(self, codelib: Any) -> Any:
        return _symbols(codelib), super().reduce(codelib)  # type: ignore[no-untyped-call]

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        return _Library.loaded(target_context.codegen(), payload)


class _KeptCounting(caching.Cache):
    """The machine code of the functions that count references.

    Otherwise numba compiles it in each process: 20 ms, and 20 MB of the compiler's code.
    """

    _impl_class: Any = _Counting


def _counting_library(target_context: Any) -> Any:
    """Return the library of the functions that count references, compiled once."""
    numbas: Any = nrtdynmod
    cache: Any = _KeptCounting(_counting_library)  # type: ignore[no-untyped-call]
    library = cache._load_overload((), target_context)
    if library is None:
        module, library = numbas.create_nrt_module(target_context)
        library.enable_object_caching()
        library.add_ir_module(module)
        library.finalize()
        cache.save_overload((), library)
    return library


def _environment(module: str, consts: Any, name: str) -> Any:
    """Return the environment of a loaded function, without importing the module it is from.

    That is for what runs as Python; numba.np.arrayobj, from which each new array comes, takes
    20 ms.
    """
    found = environment.lookup_environment(name)  # type: ignore[no-untyped-call]
    if found is None:
        globals_ = vars(sys.modules[module]) if module in sys.modules else {"__name__": module}
        found = environment.Environment(globals_)
        found.consts[:] = consts
        found.env_name = name
        environment.Environment._memo[name] = found
    return found


class _Compiling(event.Listener):
    """Hears of each function that numba compiles rather than loads."""

    def on_start(self, event: Any) -> None:
        """Inform whoever waits for it."""
        compiling.begin()

    def on_end(self, event: Any) -> None:
        """Do nothing: the next begins at once."""


def keep_by_all_sources() -> bool:
    """Have numba ask for all compiled sources from now on; before the first compiled function.

    From then on ``compiling.listeners`` hear of what is compiled. Returns whether machine code can
    be kept at all: not where this numba lacks one of its private parts.
    """
    if not all(hasattr(owner, name) for owner, name in PRIVATE):
        return False
    settings: Any = config  # its values are made when it is imported
    ours = [f"{__name__}.{one.__name__}" for one in (UserProvided, InTree, UserWide)]
    if ours[0] in settings.CACHE_LOCATOR_CLASSES:
        return True
    event.register("numba:compile", _Compiling())  # type: ignore[no-untyped-call]
    kept: Any = dispatcher
    kept.FunctionCache = _cache_of
    counting: Any = nrtdynmod
    counting.compile_nrt_functions = _counting_library
    environments: Any = environment
    environments._rebuild_env = _environment
    names = [f"{name}CacheLocator" for name in USUAL]
    others = settings.CACHE_LOCATOR_CLASSES or ",".join(
        f"{caching.__name__}.{name}" for name in names if hasattr(caching, name)
    )
    settings.CACHE_LOCATOR_CLASSES = ",".join([*ours, others])
    return True
