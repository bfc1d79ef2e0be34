"""What the house promises about itself: packages, commands and cells that are named exist."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from gapbridge.bridge.cli.table import COMMANDS

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_every_folder_with_sources_is_a_package_of_the_build() -> None:
    found = {
        path.parent for top in ("core", "drivers", "bridge") for path in (ROOT / top).rglob("*.py")
    }
    assert found
    for folder in found:
        assert (folder / "__init__.py").is_file(), f"{folder} would be missing in an installation"


def test_every_data_file_of_a_package_is_listed_for_the_build() -> None:
    listed = PROJECT["tool"]["setuptools"]["package-data"]
    package = ROOT / "gapbridge"
    shipped = {path.resolve() for pattern in listed["gapbridge"] for path in package.glob(pattern)}
    for top in ("core", "drivers", "bridge"):
        for path in (ROOT / top).rglob("*"):
            if path.suffix in (".yaml", ".script", ".css", ".js", ".html", ".typed"):
                assert path.resolve() in shipped, f"{path} would be missing in an installation"


@pytest.mark.parametrize("name", COMMANDS)
def test_the_readme_names_every_command(name: str) -> None:
    assert f"`gapbridge {name}" in README


def test_files_that_the_readme_names_exist() -> None:
    named = set(re.findall(r"(?:config|docs|drivers|bridge)/[\w./]+\.\w+", README))
    assert named
    for name in named:
        assert (ROOT / name).is_file(), name


@pytest.mark.parametrize("target", ["demo", "test", "check", "coverage"])
def test_make_has_the_targets_that_are_stated(target: str) -> None:
    assert re.search(rf"^{target}:", (ROOT / "Makefile").read_text(), re.MULTILINE)


def test_sources_cite_only_files_that_exist() -> None:
    sources = [p for top in ("core", "drivers", "bridge") for p in (ROOT / top).rglob("*.py")]
    cited = {
        (source, name)
        for source in sources
        for name in re.findall(r"(?:docs|config)/[\w/]+\.\w+", source.read_text(encoding="utf-8"))
    }
    assert cited
    assert not [(str(s), name) for s, name in cited if not (ROOT / name).is_file()]
    assert not [str(s) for s in sources if "CONTRACT" in s.read_text(encoding="utf-8")]


def test_every_import_of_ours_goes_through_the_one_package() -> None:
    """A checkout has core, drivers and bridge on its path too: a module must not be there twice."""
    ours = {"core", "drivers", "bridge"}
    for top in (*ours, "gapbridge", "tests", "benchmarks"):
        for file in (ROOT / top).rglob("*.py"):
            text = file.read_text(encoding="utf-8")
            if not re.search(r"(?:from|import|,)\s+(?:core|drivers|bridge)\b", text):
                continue  # parsing all sources takes seconds
            for node in ast.walk(ast.parse(text)):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and not node.level:
                    names = [str(node.module)]
                assert not {name.split(".")[0] for name in names} & ours, (file, names)


def test_no_folder_is_flatter_than_a_table_of_contents() -> None:
    """About twenty modules at most."""
    for top in ("core", "drivers", "bridge"):
        for folder in [ROOT / top, *(ROOT / top).rglob("*/")]:
            modules = [p.name for p in folder.glob("*.py") if p.name != "__init__.py"]
            assert len(modules) <= 21, (folder, len(modules))


LIBRARIES_ATTRIBUTES = {
    "bridge/patch/mjcf.py": {  # of MuJoCo's MjSpec
        "actuator.actearly", "actuator.biasprm", "actuator.delay", "actuator.dynprm",
        "actuator.dyntype", "actuator.gainprm", "actuator.interp", "actuator.nsample",
        "element.inertia", "element.ipos", "element.mass", "load.explicitinertial", "load.inertia",
        "load.ipos", "load.mass", "scene.spec.option.gravity", "spec_joint.armature",
        "spec_joint.damping", "spec_joint.frictionloss",
    },
    "bridge/patch/mjcf_scene.py": {
        "body.explicitinertial", "body.fullinertia", "body.ialt.type", "body.inertia", "body.ipos",
        "body.iquat", "body.mass", "body.name", "self.spec.comment",
        "self.spec.compiler.inertiafromgeom", "self.spec.compiler.settotalmass",
    },
    "bridge/served/server.py": {"server.should_exit"},  # uvicorn
    "core/kernels/machine_code.py": {  # numba
        "counting.compile_nrt_functions", "environments._rebuild_env", "kept.FunctionCache",
        "generator._engine._defined_symbols", "settings.CACHE_LOCATOR_CLASSES",
    },
    "core/limits.py": {"view.flags.writeable"},  # numpy
    "core/log/mcap_schema.py": {"field.type_name"},  # protobuf
    "drivers/canopen/configure.py": {  # canopen
        "pdo.cob_id", "pdo.enabled", "pdo.event_timer", "pdo.inhibit_time", "pdo.sync_start_value",
        "pdo.trans_type",
    },
    "drivers/canopen/master.py": {
        "remote.sdo.RESPONSE_TIMEOUT", "self.network[node].nmt.state",
        "_variable(remote, address).raw",
    },
    "drivers/ft_sensor/robotiq_ft300.py": {"line.timeout"},  # pyserial
    "drivers/simulated/canopen/drive.py": {"self.nmt.state"},  # canopen
}  # fmt: skip
"""What objects of a library are set by, by file; nothing of ours is set from outside."""
SETTERS = ("setattr", "object.__setattr__")


def _is_a_class(called: ast.expr) -> bool:
    return ast.unparse(called).split(".")[-1].lstrip("_")[:1].isupper()


def _attributes_set(function: ast.AST) -> set[str]:
    """Return the attributes that a function sets on objects it neither is nor has just made."""
    made = {"self", "cls"}
    found = set()
    for node in ast.walk(function):
        targets: list[ast.expr] = []
        if isinstance(node, ast.Assign):
            targets = [t for one in node.targets for t in getattr(one, "elts", [one])]
            if isinstance(node.value, ast.Call) and _is_a_class(node.value.func):
                made |= {t.id for t in targets if isinstance(t, ast.Name)}
        elif isinstance(node, (ast.AugAssign, ast.AnnAssign)):
            targets = [node.target]
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in SETTERS:
            targets = [ast.Attribute(node.args[0], "setattr")]
        found |= {t for t in targets if isinstance(t, ast.Attribute)}
    return {
        ast.unparse(target)
        for target in found
        if not (isinstance(target.value, ast.Name) and target.value.id in made)
    }


@pytest.mark.parametrize("folder", ["core", "drivers", "bridge"])
def test_no_part_sets_attributes_of_another(folder: str) -> None:
    for file in (ROOT / folder).rglob("*.py"):
        found: set[str] = set()
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                found |= _attributes_set(node)
        name = str(file.relative_to(ROOT))
        assert found == LIBRARIES_ATTRIBUTES.get(name, set()), name


def test_a_part_that_sets_attributes_of_another_is_noticed() -> None:
    code = "def f(self, other):\n    own = Other()\n    own.x = self.y = 1\n    {}\n"
    for line in ("other.x = 1", "self.other.x += 1", "setattr(other, 'x', 1)", "a, other.x = 1, 2",
                 "got = get(); got.x = 1"):  # fmt: skip
        assert _attributes_set(ast.parse(code.format(line))), line
    assert not _attributes_set(ast.parse(code.format("self.x = 1")))


@pytest.mark.parametrize("side", ["recording", "metrics"])  # the page predicts poses
def test_a_side_process_that_predicts_nothing_loads_nothing_that_compiles(side: str) -> None:
    code = f"import sys, gapbridge.bridge.{side}.main; print('numba' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr


def test_a_module_that_is_run_ends_with_its_run() -> None:
    """What stands after it is not there yet when a process of it runs."""
    for top in ("core", "drivers", "bridge"):
        for file in (ROOT / top).rglob("*.py"):
            text = file.read_text(encoding="utf-8")
            if "__main__" in text:
                before = ast.parse(text).body[:-1]
                guards = [n for n in before if isinstance(n, ast.If) and "__name__" in ast.dump(n)]
                assert not guards, file


def test_what_the_package_states_is_there_and_nothing_else_is_imported_for_it() -> None:
    code = (
        "import sys, gapbridge; early = {m.split('.')[0] for m in sys.modules}\n"
        "for name in dir(gapbridge): getattr(gapbridge, name)\n"
        "print(early & {'numpy', 'numba'}, {m.split('.')[0] for m in sys.modules} "
        "& {'core', 'drivers', 'bridge'})"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.stdout.split() == ["set()", "set()"], done.stdout + done.stderr


PRIVATE = {"told", "tell", "wild", "calm", "raw", "foresight", "lacking", "leftover", "promise",
           "slopes", "doubt", "suspicion", "words", "hear", "heard", "reread",
           "foreseen"}  # fmt: skip
"""What no engineer of the field would call a thing."""
FOREIGN_NAMES = {"raw_wrench", "ft_raw_wrench", "decode_raw", "raw", "tell"}
"""A sensor's reading before it is set to zero; libraries' own."""
OF_REGISTERS = (
    "drivers/modbus",
    "drivers/simulated/modbus",
    "bridge/ipc",
    "bridge/setpoint_source",
)
"""Where words are those of registers and memory."""


@pytest.mark.parametrize("folder", ["core", "drivers", "bridge"])
def test_identifiers_are_in_the_fields_words(folder: str) -> None:
    for file in (ROOT / folder).rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
        names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
        names |= {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
        names |= {n.name for n in ast.walk(tree) if isinstance(n, (ast.FunctionDef, ast.ClassDef))}
        path = str(file.relative_to(ROOT))
        private = PRIVATE - ({"words"} if path.startswith(OF_REGISTERS) else set())
        found = {n for n in names - FOREIGN_NAMES if set(n.lower().split("_")) & private}
        assert not found, (path, found)
